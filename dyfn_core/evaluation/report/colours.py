"""Depth and its error as colours; without matplotlib, which takes a second to import."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

INVALID = (70, 70, 70)
MAX_ERROR = 0.5  # relative error that the error map saturates at


def colour_depth(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """H x W depth -> H x W x 3 uint8 RGB: near is red, far is blue, in log depth; invalid grey.

    near, far: ends of the colour scale, in the unit of depth, 0 < near < far.
    """
    valid = np.isfinite(depth) & (depth > 0)
    log_depth = np.log(np.where(valid, depth, near))
    nearness = (np.log(far) - log_depth) / (np.log(far) - np.log(near))
    return _paint(cv2.COLORMAP_TURBO, nearness * 0.92 + 0.04, valid)


def colour_error(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """|d - p| / d as H x W x 3 uint8 RGB: black is right, yellow is MAX_ERROR and more."""
    valid = np.isfinite(prediction) & np.isfinite(target) & (prediction > 0) & (target > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = np.abs(prediction - target) / target
    return _paint(cv2.COLORMAP_INFERNO, np.where(valid, error, 0) / MAX_ERROR, valid)


def _paint(scale: int, values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], scale)[:, 0, ::-1]
    painted: np.ndarray = table[np.clip(values * 255, 0, 255).astype(np.uint8)]
    painted[~valid] = INVALID
    return painted


def depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """2nd and 98th percentile over the valid pixels of all depths, at least 5% apart."""
    values = [d[np.isfinite(d) & (d > 0)] for d in depths]
    joined = np.concatenate([v for v in values if v.size] or [np.ones(1)])
    near, far = np.percentile(joined, [2, 98])
    return float(near), float(max(far, near * 1.05))
