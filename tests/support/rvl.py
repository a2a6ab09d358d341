"""RVL written, after the published description."""

from __future__ import annotations

import struct

import numpy as np


def encode_rvl(image: np.ndarray) -> bytes:
    """H x W uint16 -> size and code."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            low, number = number & 7, number >> 3
            nibbles.append(low | (8 if number else 0))
            if not number:
                return

    pixels, place, previous = image.reshape(-1).tolist(), 0, 0
    while place < len(pixels):
        start = place
        while place < len(pixels) and pixels[place] == 0:
            place += 1
        put(place - start)
        start = place
        while place < len(pixels) and pixels[place]:
            place += 1
        put(place - start)
        for value in pixels[start:place]:
            difference = value - previous
            put(2 * difference if difference >= 0 else -2 * difference - 1)
            previous = value
    nibbles += [0] * (-len(nibbles) % 8)
    words = [nibbles[start : start + 8] for start in range(0, len(nibbles), 8)]
    code = [sum(n << (28 - 4 * k) for k, n in enumerate(word)) for word in words]
    return struct.pack(f"<II{len(code)}I", image.shape[1], image.shape[0], *code)
