"""Frames whose depth tells their number: frame i lies in [1 + i, 1.45 + i) metres."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dyfn_ros.recordings.frames import RecordedFrame

SIZE = (24, 32)
CAMERA = np.array([[40.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]])
SECOND = 1_000_000_000


def picture(index: int) -> np.ndarray:
    """H x W x 3 uint8, different for each number."""
    return np.random.default_rng(index).integers(0, 255, (*SIZE, 3), np.uint8)


def depth(index: int) -> np.ndarray:
    """H x W float32 metres."""
    return np.broadcast_to(1 + index + 0.45 * np.arange(SIZE[1]) / SIZE[1], SIZE).astype(np.float32)


def numbers(frames: Iterable[RecordedFrame]) -> list[int | None]:
    """Which depth each frame was paired with; checks that the values, of which most are there, are
    those of that frame."""
    found: list[int | None] = []
    for frame in frames:
        if frame.depth is None:
            found.append(None)
            continue
        number = int(np.nanmin(frame.depth)) - 1
        there = np.isfinite(frame.depth)
        assert there.mean() > 0.5
        np.testing.assert_allclose(frame.depth[there], depth(number)[there], atol=2e-3)
        found.append(number)
    return found
