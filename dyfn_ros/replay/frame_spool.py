"""Small copies of a replay's frames on disk, for outputs that need the sequence's alignment."""

from __future__ import annotations

import math
import os
import pickle
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

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
    base: predicted and solid of the base model's run; None when it was not run.
    """

    stamp_ns: int
    image: np.ndarray
    predicted: np.ndarray
    solid: np.ndarray
    truth: np.ndarray | None
    matrix: np.ndarray
    pose: np.ndarray | None
    base: tuple[np.ndarray, np.ndarray] | None = None


class _Pickles:
    """Values in a file without a name in `folder`, which goes away with the process."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by close
        self.count = 0

    def close(self) -> None:
        self._file.close()

    def push(self, value: object) -> None:
        try:
            self._file.seek(0, os.SEEK_END)
            pickle.dump(value, self._file, pickle.HIGHEST_PROTOCOL)
            self._file.flush()
        except OSError as error:
            raise cannot_write(self._folder / "(copies of frames)", error) from error
        self.count += 1

    def __iter__(self) -> Iterator[Any]:
        place = 0
        for _ in range(self.count):
            self._file.seek(place)
            value = pickle.load(self._file)
            place = self._file.tell()
            yield value


class FrameSpool:
    """Frames go in once and can be read again in order, any number of times.

    The base model's run of the same frames may follow. Raises OutputError when the files, which
    are in `folder`, cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self._frames, self._base = _Pickles(folder), _Pickles(folder)

    def __enter__(self) -> FrameSpool:
        return self

    def __exit__(self, *_: object) -> None:
        self._frames.close()
        self._base.close()

    @property
    def frames(self) -> int:
        """How many frames it holds."""
        return self._frames.count

    @property
    def has_base(self) -> bool:
        """Whether the base model's run is there."""
        return self._base.count > 0

    def push(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], pose: np.ndarray | None
    ) -> None:
        """Keep a frame, small."""
        self._frames.push(shrink(frame, prediction, pose))

    def push_base(self, prediction: Prediction[np.ndarray]) -> None:
        """Keep what the base model predicts of the next frame, small."""
        self._base.push(_small_depth(prediction))

    def __iter__(self) -> Iterator[SmallFrame]:
        for frame, base in zip_longest(self._frames, self._base):
            yield replace(frame, base=base)


def shrink(
    frame: RecordedFrame, prediction: Prediction[np.ndarray], pose: np.ndarray | None
) -> SmallFrame:
    """Every s-th row and column from s // 2, s the smallest that gives at most MAX_SIDE of them."""
    shape = prediction.depth.shape
    step, grid = _grid(shape)
    predicted, solid = _small_depth(prediction)
    matrix = prediction.camera_matrix.astype(np.float64).copy()
    matrix[:2, 2] -= step // 2
    matrix[:2] /= step
    truth = None if frame.depth is None else to_shape(frame.depth, shape)[grid].astype(np.float32)
    image = cv2.resize(frame.image, predicted.shape[::-1], interpolation=cv2.INTER_AREA)
    return SmallFrame(frame.stamp_ns, image, predicted, solid, truth, matrix, pose)


def _grid(shape: tuple[int, ...]) -> tuple[int, tuple[slice, slice]]:
    step = math.ceil(max(shape) / MAX_SIDE)
    return step, (slice(step // 2, None, step),) * 2


def _small_depth(prediction: Prediction[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """What is aligned, and where it is valid and on no depth edge, as in SmallFrame."""
    _, grid = _grid(prediction.depth.shape)
    predicted, valid = prediction.aligned_quantity
    known = valid & np.isfinite(prediction.depth) & (prediction.depth > 0)
    solid = known & ~flying_pixels(prediction.depth, known, EDGE)
    return np.where(valid, predicted, np.nan).astype(np.float32)[grid], solid[grid]
