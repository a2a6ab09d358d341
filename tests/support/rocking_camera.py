"""A camera that moves along a textured plane and looks to and fro."""

from __future__ import annotations

from functools import cache

import numpy as np

from tests.support.textured_plane import plane_view, pose_at, texture

COUNT, RATE = 40, 10  # frames, and how many a second
SECOND = 1_000_000_000


def place(seconds: float) -> np.ndarray:
    """4 x 4 camera to world at a moment."""
    look = 0.06 * np.sin(4.1 * seconds) + 0.03 * np.sin(9.7 * seconds)
    tilt = 0.03 * np.sin(6.3 * seconds + 1)
    return pose_at((0.2 * seconds, 0.05 * np.sin(2 * seconds), 0.06 * seconds), (tilt, look, 0))


@cache
def pictures() -> list[tuple[int, np.ndarray]]:
    """Stamp (nanoseconds) and H x W x 3 uint8 of each frame."""
    whole = texture()
    stamps = [SECOND + index * SECOND // RATE for index in range(COUNT)]
    return [(stamp, plane_view(place(stamp / SECOND), whole).image) for stamp in stamps]
