"""Quick scores during training."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dyfn_core.geometry.alignment import fit_scale_shift
from dyfn_core.prediction import DEPTH, DISPARITY


def known_mean(values: Iterable[float]) -> float:
    """The mean of those that are no NaN; NaN when there is none."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.mean(known)) if known else np.nan


def sequence_scores(
    predicted: list[np.ndarray], true: list[np.ndarray], quantity: str = DEPTH
) -> dict[str, float]:
    """AbsRel of a sequence under the image and video protocols (paper section 5).

    predicted, true: per frame, h x w; true depth counts where it is finite and > 1e-3. quantity:
    of the prediction; disparity is aligned with 1 / depth. Frames of fewer than 16 such pixels are
    left out; without any other both are NaN.
    """
    pairs = []
    for ours, depth in zip(predicted, true, strict=True):
        valid = np.isfinite(depth) & (depth > 1e-3)
        if valid.sum() >= 16:
            pairs.append((ours[valid].astype(np.float64), depth[valid].astype(np.float64)))
    if not pairs:
        return {"image": np.nan, "video": np.nan}
    joined = _fit(
        np.concatenate([p for p, _ in pairs]), np.concatenate([d for _, d in pairs]), quantity
    )
    alone = [_abs_rel(p, d, _fit(p, d, quantity), quantity) for p, d in pairs]
    together = [_abs_rel(p, d, joined, quantity) for p, d in pairs]
    return {"image": float(np.mean(alone)), "video": float(np.mean(together))}


def _fit(ours: np.ndarray, true: np.ndarray, quantity: str) -> tuple[float, float]:
    if quantity == DISPARITY:
        return fit_scale_shift(ours, 1 / true, true)
    return fit_scale_shift(ours, true, 1 / true)


def _abs_rel(ours: np.ndarray, true: np.ndarray, fit: tuple[float, float], quantity: str) -> float:
    aligned = fit[0] * ours + fit[1]
    depth = 1 / np.maximum(aligned, 1e-4) if quantity == DISPARITY else aligned
    return float(np.mean(np.abs(np.maximum(depth, 1e-3) - true) / true))
