"""Scales that no camera's world has."""

from __future__ import annotations

import math

import numpy as np

MIDDLE = (0.005, 2000.0)  # metres, of the median depth of a picture
IMPLAUSIBLE = "implausible scale"
_STEP = 4


def middle_depth(depth: np.ndarray, valid: np.ndarray) -> float:
    """Median of the valid depth, on every fourth row and column; NaN without any.

    depth: H x W. valid: H x W bool.
    """
    few = (slice(None, None, _STEP),) * 2
    found = depth[few][valid[few]]
    return float(np.median(found)) if found.size else math.nan


def implausible(scale: float, metres: float) -> str:
    """Why a scale is none, when it gives so many metres to the middle of a picture; or ""."""
    low, high = MIDDLE
    if math.isnan(metres) or low <= metres <= high:
        return ""
    return (
        f"{IMPLAUSIBLE} {scale:.3g}: the picture's median depth would be {metres:.3g} m, "
        f"expected {low:g} to {high:g}"
    )
