"""Robust fits of a metric scale to few points with many outliers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from dyfn_core.geometry.alignment import align_scale_shift

_KEPT = 2.5  # standard deviations within which a point counts as an inlier
_LEAST_SPREAD = 1e-3  # of log ratios; what a perfect fit is taken to have
_ANCHORS = 256  # the scale-and-shift fit is quadratic in the number of points
_TRUNCATION = 0.3  # relative error beyond which a point is just an outlier, there


class NoFitError(ValueError):
    """The points do not say what the scale is; the text says why."""


@dataclass(frozen=True)
class MetricMap:
    """metres = scale * depth + shift."""

    scale: float
    shift: float = 0.0

    def __call__(self, depth: np.ndarray) -> np.ndarray:
        return depth * self.scale + self.shift


@dataclass(frozen=True)
class Fit:
    """A metric map and how well it is supported.

    spread: robust standard deviation of log(measured / mapped) over the inliers: 0.1 is 10%.
    inliers, total: points within 2.5 spreads, and all. level: their median predicted depth.
    """

    map: MetricMap
    spread: float
    inliers: int
    total: int
    level: float


def robust_centre(values: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Centre, standard deviation and inliers (N bool) of values of which up to half are wrong.

    Least median of squares (the middle of the shortest half), then the mean and the standard
    deviation of what lies within 2.5 deviations of it (Rousseeuw & Leroy, 1987). values: N >= 2.
    """
    ordered = np.sort(values)
    half = len(ordered) // 2 + 1
    widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    start = int(widths.argmin())
    centre = float(ordered[start] + ordered[start + half - 1]) / 2
    first = 1.4826 * (1 + 5 / (len(ordered) - 1)) * float(widths[start]) / 2
    sigma = first = max(first, _LEAST_SPREAD)
    for _ in range(3):
        kept = np.abs(values - centre) <= _KEPT * sigma
        centre = float(values[kept].mean())
        # Of 40% outliers the half holds nearly all inliers: first is then 3 times too wide.
        sigma = max(1.05 * float(values[kept].std()), first / 2)
    return centre, sigma, np.abs(values - centre) <= _KEPT * sigma


def fit_scale(
    predicted: np.ndarray, measured: np.ndarray, *, min_points: int = 10, max_spread: float = 0.35
) -> Fit:
    """The scale of N predicted depths against N measured ones (metres), both > 0.

    Works on log ratios: the errors of predicted depth are relative. Stands up to 40% outliers
    in 10 points. Raises NoFitError: fewer than min_points, fewer than half of them agreeing on one
    scale, or a spread above max_spread; ValueError for arrays of other shapes or values.
    """
    x, y = _checked(predicted, measured, min_points)
    ratios = np.log(y / x)
    centre, spread, kept = robust_centre(ratios)
    _check_support(int(kept.sum()), len(x), spread, max_spread)
    return Fit(
        MetricMap(math.exp(centre)), spread, int(kept.sum()), len(x), float(np.median(x[kept]))
    )


def fit_scale_and_shift(
    predicted: np.ndarray, measured: np.ndarray, *, min_points: int = 10, max_spread: float = 0.35
) -> Fit:
    """As fit_scale, with a shift along the depth as well; for streams without a known shift.

    Truncated relative L1 over all anchors, then least squares on the inliers. Also raises
    NoFitError when the depths span less than a factor of 1.2: shift and scale are then one.
    """
    x, y = _checked(predicted, measured, min_points)
    few = np.unique(np.linspace(0, len(x) - 1, _ANCHORS).round().astype(int))
    predicted_row, measured_row, weight = (
        torch.from_numpy(values[few])[None] for values in (x, y, 1 / y)
    )
    start = align_scale_shift(predicted_row, measured_row, weight, _TRUNCATION)
    scale, shift = float(start[0]), float(start[1])
    kept = _near(x, y, scale, shift)
    for _ in range(3):
        if kept.sum() < 3:
            break
        design = np.column_stack([x, np.ones_like(x)])[kept] / y[kept, None]
        scale, shift = np.linalg.lstsq(design, np.ones(int(kept.sum())), rcond=None)[0]
        kept = _near(x, y, scale, shift)
    if kept.sum() < 3 or scale <= 0:
        raise NoFitError(f"no scale and shift fits {len(x)} points")
    if np.quantile(x[kept], 0.95) < 1.2 * np.quantile(x[kept], 0.05):
        raise NoFitError("the depths span too little to tell a shift from a scale")
    spread = max(float(np.std(np.log(y[kept] / (scale * x[kept] + shift)))), _LEAST_SPREAD)
    _check_support(int(kept.sum()), len(x), spread, max_spread)
    return Fit(
        MetricMap(float(scale), float(shift)),
        spread,
        int(kept.sum()),
        len(x),
        float(np.median(x[kept])),
    )


def _near(x: np.ndarray, y: np.ndarray, scale: float, shift: float) -> np.ndarray:
    """Inliers of a scale and shift: within 2.5 robust deviations, mapped before the camera."""
    mapped = scale * x + shift
    before = mapped > 0
    residual = np.full(len(x), np.inf)
    residual[before] = np.abs(np.log(y[before] / mapped[before]))
    sigma = 1.4826 * (1 + 5 / max(len(x) - 2, 1)) * float(np.median(residual))
    return residual <= _KEPT * min(max(sigma, _LEAST_SPREAD), _TRUNCATION)


def _checked(
    predicted: np.ndarray, measured: np.ndarray, min_points: int
) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.asarray(predicted, np.float64), np.asarray(measured, np.float64)
    if x.ndim != 1 or x.shape != y.shape:
        raise ValueError(f"expected two arrays of N numbers, got shapes {x.shape} and {y.shape}")
    if not (np.isfinite(x).all() and np.isfinite(y).all() and (x > 0).all() and (y > 0).all()):
        raise ValueError("depths must be finite and positive")
    if len(x) < max(min_points, 2):
        raise NoFitError(f"{len(x)} points, needs {max(min_points, 2)}")
    return x, y


def _check_support(inliers: int, total: int, spread: float, max_spread: float) -> None:
    if 2 * inliers < total:
        raise NoFitError(f"only {inliers} of {total} points agree on one scale")
    if spread > max_spread:
        raise NoFitError(f"the points' scales spread by {spread:.2f}, allowed are {max_spread:.2f}")
