"""Pictures of turned rectangles at different depths, whose edges are those of the depth."""

from __future__ import annotations

import cv2
import numpy as np

SIZE = (72, 96)
MATRIX = np.array([[80.0, 0, 47.5], [0, 80.0, 35.5], [0, 0, 1]])


def rectangles(index: int) -> tuple[np.ndarray, np.ndarray]:
    """H x W x 3 uint8 RGB, and H x W float32 metres of 1 to 4."""
    draw = np.random.default_rng(index)
    image = np.full((*SIZE, 3), 90, np.uint8)
    depth = np.full(SIZE, 4, np.float32)
    for distance in np.linspace(3.5, 1, 6):
        centre = draw.uniform(0, 1, 2) * SIZE[::-1]
        box = (centre.tolist(), draw.uniform(14, 40, 2).tolist(), float(draw.uniform(0, 90)))
        corners = cv2.boxPoints(box).round().astype(np.int32)
        cv2.fillPoly(image, [corners], draw.integers(0, 255, 3).tolist())
        cv2.fillPoly(depth, [corners], float(distance))
    return image, depth
