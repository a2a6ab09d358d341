"""Small videos, made with PyAV."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

TICKS = Fraction(1, 90_000)


def grey(index: int, size: tuple[int, int]) -> np.ndarray:
    """20 x the index all over, from 0 again at 260."""
    return np.full((*size, 3), 20 * index % 260, np.uint8)


def panning(index: int, size: tuple[int, int]) -> np.ndarray:
    """One picture of blocks, a pixel further with each index."""
    blocks = np.random.default_rng(1).integers(0, 255, (6, 8, 3), np.uint8)
    return np.ascontiguousarray(np.roll(cv2.resize(blocks, size[::-1]), index, axis=1))


def make_video(
    path: Path,
    times: Sequence[float],
    size: tuple[int, int] = (48, 64),
    picture: Callable[[int, tuple[int, int]], np.ndarray] = grey,
) -> Path:
    """H.264 whose frames are at these seconds; picture(index, (H, W)): H x W x 3 uint8 RGB."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"preset": "ultrafast"})
        stream.height, stream.width = size
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = stream.time_base = TICKS
        for index, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(picture(index, size))
            frame.pts, frame.time_base = round(time / TICKS), TICKS
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def turn_right(path: Path) -> Path:
    """Mark an MP4 as one that is to be shown turned by 90 degrees clockwise, as phones do."""
    content = bytearray(path.read_bytes())
    place = content.index(b"tkhd") + 44  # the matrix, after the name and the fields of version 0
    content[place : place + 36] = struct.pack(
        ">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 64 << 16, 0, 1 << 30
    )
    path.write_bytes(content)
    return path
