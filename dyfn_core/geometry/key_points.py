"""Key points of a picture that are found again after a large motion: SIFT, told apart exactly."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

_CONTRAST = 0.01  # a fourth of OpenCV's: blurred pictures and bare rooms have few corners
_EDGE = 15.0
_LENGTH = 512  # of a descriptor; sums of products stay below 2^24, where float32 is exact
_RATIO = 0.85  # of the distance to the second best descriptor


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one picture.

    Attributes:
        points: N x 2 float32, (x, y) as shares of the picture's width and height.
        descriptors: N x 128 uint8, of nearly the same length.
    """

    points: np.ndarray
    descriptors: np.ndarray

    def where(self, kept: np.ndarray) -> KeyPoints:
        """Some of them, N bool or indices."""
        return KeyPoints(self.points[kept], self.descriptors[kept])


def find_key_points(image: np.ndarray, long_side: int, most: int) -> KeyPoints:
    """The strongest key points, in an order that depends on the picture alone.

    Args:
        image: H x W x 3 uint8 RGB.
        long_side: Pixels of the longer side that the picture is shrunk to.
        most: Key points at most.

    Returns:
        The key points; none in a picture without structure.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    factor = min(1.0, long_side / max(height, width))
    if factor < 1:
        size = (max(round(width * factor), 1), max(round(height * factor), 1))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT_create(nfeatures=most, contrastThreshold=_CONTRAST, edgeThreshold=_EDGE)  # type: ignore[attr-defined]
    found, described = sift.detectAndCompute(grey, None)
    if described is None:
        return KeyPoints(np.empty((0, 2), np.float32), np.empty((0, 128), np.uint8))
    found, described = found[:most], described[:most].astype(np.float64)
    # The square roots of a descriptor's shares tell more than the descriptor (Arandjelovic and
    # Zisserman, CVPR 2012).
    shares = described / np.maximum(described.sum(axis=1, keepdims=True), 1.0)
    places = np.array([point.pt for point in found]) + 0.5
    return KeyPoints(
        (places / [grey.shape[1], grey.shape[0]]).astype(np.float32),
        np.rint(np.sqrt(shares) * _LENGTH).clip(0, 255).astype(np.uint8),
    )


def matched(first: KeyPoints, second: KeyPoints) -> tuple[np.ndarray, np.ndarray]:
    """Key points that are each other's nearest, and clearly nearer than the second nearest.

    The products are whole numbers that float32 holds exactly: the same pairs on every machine.

    Args:
        first: Of one picture.
        second: Of another one.

    Returns:
        Indices into the first and into the second, of one length.
    """
    none = np.empty(0, np.int64)
    if len(first.points) < 2 or len(second.points) < 2:
        return none, none
    a, b = (points.descriptors.astype(np.float32) for points in (first, second))
    alike = a @ b.T
    lengths = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)
    squared = np.maximum(lengths - 2 * alike, 0.0)
    rows = np.arange(len(a))
    best = squared.argmin(axis=1)
    nearest = squared[rows, best]
    mutual = squared.argmin(axis=0)[best] == rows
    squared[rows, best] = np.inf
    kept = mutual & (nearest < _RATIO**2 * squared.min(axis=1))
    return rows[kept], best[kept]
