"""Samples of predictions and truths of a sequence, in flat arrays."""

from __future__ import annotations

from array import array
from collections.abc import Iterator

import numpy as np


class Samples:
    """Predictions and truths of a sequence's samples, one frame after the other."""

    def __init__(self) -> None:
        self._prediction, self._target = array("f"), array("f")
        self._counts = array("q")  # a frame

    @property
    def size(self) -> int:
        """Samples of all frames."""
        return len(self._prediction)

    @property
    def prediction(self) -> np.ndarray:
        """Of all frames, float32."""
        return np.array(self._prediction)

    @property
    def target(self) -> np.ndarray:
        """Of all frames, float64: weights are computed from it."""
        return np.array(self._target, np.float64)

    def append(self, prediction: np.ndarray, target: np.ndarray) -> None:
        """The next frame: N float32 each."""
        self._prediction.frombytes(prediction.tobytes())
        self._target.frombytes(target.tobytes())
        self._counts.append(prediction.size)

    @property
    def most(self) -> int:
        """Of one frame."""
        return max(self._counts, default=0)

    def __len__(self) -> int:
        return len(self._counts)

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """The frames' predictions and truths; views that must be gone before an append."""
        prediction = np.frombuffer(self._prediction, np.float32)
        target = np.frombuffer(self._target, np.float32)
        start = 0
        for count in self._counts:
            yield prediction[start : start + count], target[start : start + count]
            start += count

    def halved(self) -> Samples:
        """Every second sample of every frame."""
        half = Samples()
        for prediction, target in self:
            half.append(prediction[::2], target[::2])
        return half
