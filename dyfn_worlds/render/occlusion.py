"""Ambient occlusion from a depth image: corners and the feet of things are darker."""

from __future__ import annotations

import numpy as np

SHIFTS = ((2, 0), (0, 2), (4, 4), (4, -4), (9, 0), (0, 9), (14, 14), (14, -14))  # pixels: x, y
REACH = 0.25  # metres at which a neighbour's influence has fallen to 1 / e


def shade_corners(
    image: np.ndarray, depth: np.ndarray, focal: float, strength: float
) -> np.ndarray:
    """image H x W x 3 uint8, depth H x W metres (inf: sky), focal over the width -> darker image.

    The inverse depth of a plane is linear in the image, so that the mean of two opposite
    neighbours differs from the middle only at a crease; a neighbour far in front of it is
    another thing and does not count.
    """
    if strength <= 0:
        return image
    share = occlusion(depth, focal * depth.shape[1])
    dark = 1 - 0.75 * strength * share
    return (image * np.sqrt(dark)[..., None]).astype(np.uint8)


def occlusion(depth: np.ndarray, focal_px: float) -> np.ndarray:
    """H x W in 0..1: how much of its surroundings each pixel's surface does not see."""
    inverse = np.where(np.isfinite(depth), 1 / np.maximum(depth, 1e-3), 0).astype(np.float32)
    height, width = depth.shape
    z = np.where(np.isfinite(depth), depth, 100.0).astype(np.float32)
    total, margin = np.zeros((height, width), np.float32), 14
    padded = np.pad(inverse, margin, mode="edge")

    def moved(x: int, y: int) -> np.ndarray:
        return padded[margin + y : margin + y + height, margin + x : margin + x + width]

    for x, y in SHIFTS:
        apart = np.float32(np.hypot(x, y) / focal_px) * z  # metres
        nearer = ((moved(x, y) + moved(-x, -y)) / 2 - inverse) * z * z
        slope = nearer / apart
        share = np.clip(slope, 0, 1) * np.clip(2.2 - slope, 0, 1) * np.exp(-apart / REACH)
        total += share
    result: np.ndarray = np.clip(total / 3.0, 0, 1)
    return result
