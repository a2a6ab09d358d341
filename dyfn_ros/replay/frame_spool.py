"""Small copies of a replay's frames on disk, for outputs that need the sequence's alignment."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.files import cannot_write
from dyfn_core.geometry.edges import flying_pixels
from dyfn_core.prediction import Prediction
from dyfn_core.scoring.protocols import to_shape
from dyfn_ros.recordings.open import RecordedFrame

MAX_SIDE = 320  # pixels of the longer side of what is kept
EDGE = 0.05  # relative depth step between neighbours that makes both flying pixels


@dataclass(frozen=True)
class SmallFrame:
    """Every s-th pixel of a frame.

    image: h x w x 3 uint8 RGB (averaged, not picked). predicted: h x w float32, depth or disparity,
    NaN where invalid. solid: h x w bool, valid and on no depth edge.
    truth: h x w float32 metres, NaN invalid; None without. matrix: 3 x 3 pixels of this grid.
    pose: 4 x 4 camera to world, metres; None when unknown.
    """

    stamp_ns: int
    image: np.ndarray
    predicted: np.ndarray
    solid: np.ndarray
    truth: np.ndarray | None
    matrix: np.ndarray
    pose: np.ndarray | None


class FrameSpool:
    """Frames go in once and can be read again in order, any number of times.

    They are in a file without a name in `folder`, which goes away with the process. Raises
    OutputError when it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by __exit__
        self.frames = 0

    def __enter__(self) -> FrameSpool:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def push(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], pose: np.ndarray | None
    ) -> None:
        """Keep a frame, small."""
        small = shrink(frame, prediction, pose)
        missing = np.empty(0)
        arrays = (
            np.array(small.stamp_ns),
            small.image,
            small.predicted,
            small.solid,
            missing if small.truth is None else small.truth,
            small.matrix,
            missing if small.pose is None else small.pose,
        )
        try:
            for array in arrays:
                np.save(self._file, array, allow_pickle=False)
            self._file.flush()
        except OSError as error:
            raise cannot_write(self._folder / "(copies of frames)", error) from error
        self.frames += 1

    def __iter__(self) -> Iterator[SmallFrame]:
        place = 0
        for _ in range(self.frames):
            self._file.seek(place)
            stamp, image, predicted, solid, truth, matrix, pose = (
                np.load(self._file) for _ in range(7)
            )
            place = self._file.tell()
            yield SmallFrame(
                int(stamp),
                image,
                predicted,
                solid,
                truth if truth.size else None,
                matrix,
                pose if pose.size else None,
            )


def shrink(
    frame: RecordedFrame, prediction: Prediction[np.ndarray], pose: np.ndarray | None
) -> SmallFrame:
    """Every s-th row and column from s // 2, s the smallest that gives at most MAX_SIDE of them."""
    shape = prediction.depth.shape
    step = math.ceil(max(shape) / MAX_SIDE)
    grid = (slice(step // 2, None, step),) * 2
    predicted, valid = prediction.aligned_quantity
    known = valid & np.isfinite(prediction.depth) & (prediction.depth > 0)
    solid = known & ~flying_pixels(prediction.depth, known, EDGE)
    matrix = prediction.camera_matrix.astype(np.float64).copy()
    matrix[:2, 2] -= step // 2
    matrix[:2] /= step
    small = np.where(valid, predicted, np.nan).astype(np.float32)[grid]
    truth = None if frame.depth is None else to_shape(frame.depth, shape)[grid].astype(np.float32)
    image = cv2.resize(frame.image, small.shape[::-1], interpolation=cv2.INTER_AREA)
    return SmallFrame(frame.stamp_ns, image, small, solid[grid], truth, matrix, pose)
