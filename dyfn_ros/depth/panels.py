"""Pictures of a frame and its depth, in colours that follow the scene slowly."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from dyfn_core.evaluation.report.colours import colour_depth, depth_range
from dyfn_core.evaluation.report.frame_grid import depth_bar, draw_bars
from dyfn_core.prediction import Prediction
from dyfn_core.scoring.protocols import sample_grid

FOLLOW = 3.0  # seconds in which the colours follow the scene by 1 - 1 / e
SAMPLES = 20_000  # pixels that the range of a frame is of
MARGIN = 1.1  # of the range of colours around that of a frame
SMALLEST_BAR = 320  # pixels: a narrower picture has no scale of colours
RELATIVE, METRES = "depth, no unit", "depth, m"


class ColourRange:
    """The depths of the nearest and the farthest colour.

    They follow each frame's 2nd and 98th percentile slowly, so that flicker and drift of the depth
    are seen and a new place is not left without colours. They start anew with the stream.
    """

    def __init__(self, near: float | None = None, far: float | None = None) -> None:
        """Begin; `near` and `far` hold an end where it is given."""
        self._given = near, far
        self._ends: np.ndarray | None = None
        self._last: tuple[float, bool] = (0.0, False)  # stamp, metric

    def update(self, prediction: Prediction[np.ndarray], stamp: float) -> tuple[float, float]:
        """The range for a frame, in the unit of its depth; stamp: seconds."""
        grid = sample_grid(prediction.depth.shape, SAMPLES)
        valid = prediction.valid[grid]
        before, metric = self._last
        anew = prediction.reset is not None or prediction.metric != metric
        if valid.any():
            near, far = depth_range([prediction.depth[grid][valid]])
            found = np.log([near / MARGIN, far * MARGIN])
            share = 1 - math.exp(-max(stamp - before, 0.0) / FOLLOW)
            if self._ends is None or anew:
                self._ends = found
            else:
                self._ends = self._ends + share * (found - self._ends)
            self._last = stamp, prediction.metric
        ends = np.exp(np.log([1.0, 2.0]) if self._ends is None else self._ends)
        near, far = (float(e if g is None else g) for e, g in zip(ends, self._given, strict=True))
        if near < far:
            return near, far
        return (near, 2 * near) if self._given[0] is not None else (far / 2, far)


@dataclass(frozen=True)
class Panels:
    """How a frame is drawn.

    Attributes:
        kind: "both": input, depth and a scale of the colours; "depth" alone.
        size: Longest side of each, pixels.
    """

    kind: Literal["both", "depth"]
    size: int

    def draw(
        self, image: np.ndarray, prediction: Prediction[np.ndarray], ends: tuple[float, float]
    ) -> np.ndarray:
        """H x W x 3 uint8 RGB.

        Args:
            image: H x W x 3 uint8 RGB.
            prediction: Of the same size.
            ends: Depth of the nearest and the farthest colour.
        """
        height, width = image.shape[:2]
        share = min(1.0, self.size / max(height, width))
        small = max(1, round(width * share)), max(1, round(height * share))
        depth: np.ndarray = np.where(prediction.valid, prediction.depth, np.nan)
        if share < 1:
            depth = cv2.resize(depth, small, interpolation=cv2.INTER_NEAREST)
        colours = colour_depth(depth, *ends)
        if self.kind == "depth":
            return colours
        if share < 1:
            image = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
        both = np.hstack([image, colours])
        if both.shape[1] < SMALLEST_BAR:
            return both
        label = METRES if prediction.metric else RELATIVE
        return np.vstack([both, draw_bars([depth_bar(*ends, label)], both.shape[1])])
