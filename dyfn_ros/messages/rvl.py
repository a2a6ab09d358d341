"""RVL, the lossless run-length code of depth images of Wilson (2017), for compressedDepth.

A row-major image is runs of zeros and of values: how many zeros, how many values, then each value's
difference to the value before (zigzag). A number is nibbles of three bits, the lowest first, whose
fourth bit says that more follow; eight nibbles are a 32-bit word, the first the highest.
"""

from __future__ import annotations

import struct

import numpy as np

from dyfn_ros.messages.encodings import MessageError
from dyfn_ros.messages.picture_size import MAX_PIXELS

_SIZE = struct.Struct("<II")  # columns, rows
_LONGEST = 11  # nibbles of a number of 32 bits


def decode_rvl(data: bytes) -> np.ndarray:
    """Size and code, as compressedDepth has them behind its header -> H x W uint16.

    Raises MessageError: no such code, or more than MAX_PIXELS.
    """
    if len(data) < _SIZE.size:
        raise MessageError(f"the RVL image ends early: {len(data)} bytes")
    columns, rows = _SIZE.unpack_from(data)
    total = columns * rows
    if total > MAX_PIXELS:
        raise MessageError(
            f"the RVL image says that it is {columns} x {rows} pixels; at most {MAX_PIXELS} "
            f"({MAX_PIXELS >> 20} megapixels) are decoded"
        )
    numbers = _numbers(data[_SIZE.size :])
    filled, differences = _runs(numbers, total)
    values = np.cumsum((differences >> 1) ^ -(differences & 1))
    if values.size and (values.min() < 0 or values.max() > 0xFFFF):
        raise MessageError("the RVL image is damaged: values beyond 16 bits")
    image = np.zeros(total, np.uint16)
    image[filled] = values
    return image.reshape(rows, columns)


def _numbers(code: bytes) -> np.ndarray:
    """Every number of the code, int64."""
    words = np.frombuffer(code[: len(code) // 4 * 4], "<u4")
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).reshape(-1)
    ends = np.flatnonzero(nibbles < 8)
    if ends.size == 0:
        return np.zeros(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > _LONGEST:
        raise MessageError("the RVL image is damaged: a number of more than 32 bits")
    places = np.arange(ends[-1] + 1) - np.repeat(starts, lengths)
    bits = (nibbles[: ends[-1] + 1] & 7).astype(np.int64) << (3 * places)
    numbers: np.ndarray = np.add.reduceat(bits, starts)
    return numbers


def _runs(numbers: np.ndarray, total: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of the pixels have values (bool), and the values' differences."""
    filled = np.zeros(total, bool)
    pieces = [np.zeros(0, np.int64)]
    pixel = place = 0
    while pixel < total:
        if place + 2 > len(numbers):
            raise MessageError(f"the RVL image ends early: {pixel} of {total} pixels")
        zeros, count = int(numbers[place]), int(numbers[place + 1])
        place += 2
        pixel += zeros
        if pixel + count > total or place + count > len(numbers) or zeros + count == 0:
            raise MessageError(f"the RVL image is damaged at pixel {min(pixel, total)} of {total}")
        filled[pixel : pixel + count] = True
        pieces.append(numbers[place : place + count])
        pixel, place = pixel + count, place + count
    return filled, np.concatenate(pieces)
