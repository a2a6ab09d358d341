"""Errors of a depth prediction against the truth (paper section 5)."""

from __future__ import annotations

import numpy as np

METRICS = (
    "abs_rel",
    "delta1",
    "delta2",
    "delta3",
    "rmse",
    "log10",
    "sq_rel",
    "rmse_log",
    "i_rmse",
    "silog",
    "mae",
    "i_mae",
)


def depth_metrics(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None
) -> dict[str, float]:
    """All METRICS over the valid pixels of one frame.

    prediction, target: same shape, positive depth in the same unit (metres for rmse, mae, sq_rel).
    mask: same shape bool, True where the pixel counts; None counts all of them.

    abs_rel = mean |d - p| / d; deltaK = share with max(p / d, d / p) < 1.25^K; rmse in the unit
    of depth, i_rmse in its inverse, mae and i_mae = mean |p - d| likewise; rmse_log natural,
    log10 = mean |log10 p - log10 d|;
    silog = 100 * standard deviation of log p - log d.
    Raises ValueError on differing shapes, no pixel to score, or depth that is not positive.
    """
    p, d = _valid(prediction, target, mask)
    error = p - d
    ratio = np.maximum(p / d, d / p)
    log_error = np.log(p) - np.log(d)
    return {
        "abs_rel": float(np.mean(np.abs(error) / d)),
        "delta1": float(np.mean(ratio < 1.25)),
        "delta2": float(np.mean(ratio < 1.25**2)),
        "delta3": float(np.mean(ratio < 1.25**3)),
        "rmse": float(np.sqrt(np.mean(error**2))),
        "log10": float(np.mean(np.abs(log_error)) / np.log(10)),
        "sq_rel": float(np.mean(error**2 / d)),
        "rmse_log": float(np.sqrt(np.mean(log_error**2))),
        "i_rmse": float(np.sqrt(np.mean((1 / p - 1 / d) ** 2))),
        "silog": float(100 * np.std(log_error)),
        "mae": float(np.mean(np.abs(error))),
        "i_mae": float(np.mean(np.abs(1 / p - 1 / d))),
    }


def _valid(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    p, d = np.asarray(prediction, np.float64), np.asarray(target, np.float64)
    if p.shape != d.shape or (mask is not None and np.shape(mask) != d.shape):
        shapes = [a.shape for a in (p, d)] + ([] if mask is None else [np.shape(mask)])
        raise ValueError(f"prediction, target and mask must share one shape, got {shapes}")
    if mask is not None:
        p, d = p[mask], d[mask]
    if d.size == 0:
        raise ValueError("no valid pixel to score")
    for name, values in (("prediction", p), ("target", d)):
        if not (np.isfinite(values).all() and values.min() > 0):
            raise ValueError(f"{name} must be finite and positive where it is valid")
    return p.ravel(), d.ravel()


def mean_metrics(frames: list[dict[str, float]]) -> dict[str, float]:
    """Mean over frames of every metric; raises ValueError when there are no frames."""
    if not frames:
        raise ValueError("no frame has a score")
    return {name: float(np.mean([frame[name] for frame in frames])) for name in frames[0]}
