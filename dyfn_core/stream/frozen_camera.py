"""A camera whose pictures have the same bytes again and again."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import numpy as np

from dyfn_core.geometry.rigid import inverse, size_of

_ALIKE = 10  # pictures in a row before a camera at rest is taken for frozen
_ALIKE_MOVING = 3  # the same while the odometry says that the camera has moved
_MOVED = (math.radians(2.0), 0.05)  # radians, metres
_SAMPLE = 8  # every so many rows and columns are compared before all are


@dataclass(frozen=True)
class _Last:
    sample: np.ndarray
    checksum: int | None = None  # of all bytes, once it was needed


class FrozenCamera:
    """Counts pictures in a row that have the same bytes."""

    def __init__(self) -> None:
        self._last: _Last | None = None
        self._alike = 0
        self._since: float | None = None
        self._from: np.ndarray | None = None

    def push(self, image: np.ndarray, stamp: float | None, pose: np.ndarray | None) -> None:
        """The next picture; arguments as of a Frame."""
        last, sample, checksum = self._last, image[::_SAMPLE, ::_SAMPLE].copy(), None
        if last is not None and np.array_equal(sample, last.sample):
            checksum = zlib.crc32(np.ascontiguousarray(image).data)
        alike = checksum is not None and last is not None and last.checksum in (None, checksum)
        if not alike:
            self._alike, self._since, self._from = 0, stamp, pose
        self._last, self._alike = _Last(sample, checksum), self._alike + 1

    def frozen(self, stamp: float | None, pose: np.ndarray | None, after: float) -> bool:
        """Whether the camera is frozen at this stamp and pose. after: seconds."""
        if self._alike >= _ALIKE_MOVING and _moved(self._from, pose):
            return True
        known = stamp is not None and self._since is not None
        long = not known or (stamp or 0.0) - (self._since or 0.0) >= after
        return self._alike >= _ALIKE and long

    def reset(self) -> None:
        """Forget the last picture."""
        self._last, self._alike = None, 0


def _moved(before: np.ndarray | None, now: np.ndarray | None) -> bool:
    if before is None or now is None:
        return False
    angle, distance = size_of(inverse(before) @ now)
    return angle > _MOVED[0] or distance > _MOVED[1]
