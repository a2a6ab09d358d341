"""What a method's values are: depth, inverse depth, or disparity with an unknown offset."""

from __future__ import annotations

import numpy as np

DEPTH, DISPARITY, INVERSE = "depth", "disparity", "inverse"
QUANTITIES = (DEPTH, DISPARITY, INVERSE)  # of files
AFFINE_DEPTH = "affine_depth"  # of models whose depth has an unknown scale and an unknown shift


def scored_quantity(kind: str) -> str:
    """How values of a kind are aligned: disparity as such, the others as depth.

    Every alignment with depth fits a scale and a shift, so AFFINE_DEPTH is scored as DEPTH.

    Raises:
        ValueError: `kind` is neither one of QUANTITIES nor AFFINE_DEPTH.
    """
    if kind not in (*QUANTITIES, AFFINE_DEPTH):
        raise ValueError(f"quantity {kind!r} is unknown, expected one of {QUANTITIES}")
    return DISPARITY if kind == DISPARITY else DEPTH


def scored_values(values: np.ndarray, kind: str) -> np.ndarray:
    """Convert values of one of QUANTITIES to what scored_quantity names.

    Args:
        values: Any shape. Inverse depth has no unknown offset and becomes depth.
        kind: One of QUANTITIES.

    Returns:
        float32 of the same shape; NaN where inverse depth is not positive.
    """
    values = np.asarray(values, np.float32)
    if kind != INVERSE:
        return values
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values > 0, 1 / values, np.float32(np.nan))
