"""A smooth field of log scale over the picture: what one scale leaves wrong in the shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.linalg import cho_factor, cho_solve

_DEPTH = 0.2  # weight of log depth beside the place in the picture
_OUTLIER = 2.0  # expected misfits at which a point has lost half of its weight
_ROUNDS = 3  # of weighing the points by their misfits


@dataclass(frozen=True)
class FieldOptions:
    """A Gaussian process over (x, y, log depth).

    Attributes:
        length: of its kernel, as a share of the picture's longer side.
        deviation: its prior standard deviation.
        most: points that it is conditioned on, the most certain ones.
        step: pixels between the places where it is evaluated; it is interpolated in between.
    """

    length: float = 0.2
    deviation: float = 0.2
    most: int = 400
    step: int = 8


def scale_field(
    pixels: np.ndarray,
    residuals: np.ndarray,
    noise: np.ndarray,
    depth: np.ndarray,
    options: FieldOptions,
    misfit: np.ndarray | None = None,
) -> np.ndarray:
    """The field that explains the points' residual log ratios.

    Points on things that move, or that something hides by now, lose weight.

    Args:
        pixels: N x 2, (x, y).
        residuals: N, log(measured / predicted) less the frame's log scale.
        noise: N, standard deviations of the residuals, as far as they may err alike.
        depth: H x W predicted depth; not finite or <= 0 where there is no prediction.
        options: see FieldOptions.
        misfit: N, standard deviations of what the field leaves of a residual; None: `noise`.

    Returns:
        H x W float32, to be added to log depth; 0 without points.
    """
    height, width = depth.shape
    if not len(residuals):
        return np.zeros((height, width), np.float32)
    misfit = noise if misfit is None else misfit
    if len(residuals) > options.most:
        best = np.sort(np.argsort(noise, kind="stable")[: options.most])
        pixels, residuals, noise, misfit = (a[best] for a in (pixels, residuals, noise, misfit))
    rows = np.clip(np.rint(pixels[:, 1]).astype(int), 0, height - 1)
    columns = np.clip(np.rint(pixels[:, 0]).astype(int), 0, width - 1)
    logs = _log(depth[rows, columns])
    middle = float(np.median(logs[np.isfinite(logs)])) if np.isfinite(logs).any() else 0.0
    longest = max(height, width)
    inside = _features(pixels / longest, logs, middle, options)
    weights = _conditioned(_kernel(inside, inside, options), residuals, noise, misfit)
    step = min(options.step, height, width)
    y, x = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    coarse = _log(depth[grid[:, 1], grid[:, 0]])
    outside = _features(grid / longest, coarse, middle, options)
    single = np.float32  # enough here, and twice as fast
    near = _kernel(outside.astype(single), inside.astype(single), options)
    # Rounding hides the last bits, which the number of threads of the solution decides.
    values = (near @ weights.astype(single)).reshape(len(y), len(x))
    return _enlarged(values, (height, width), step)


def _enlarged(values: np.ndarray, size: tuple[int, int], step: int) -> np.ndarray:
    """Values at pixels step // 2, step // 2 + step, ... at every pixel."""
    x, y = _places((values.shape[0], values.shape[1]), size, step)
    return np.asarray(cv2.remap(values, x, y, cv2.INTER_LINEAR))


@lru_cache(4)
def _places(
    coarse: tuple[int, int], size: tuple[int, int], step: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel is among the coarse values, as cv2.remap's fixed-point maps."""
    height, width = size
    x = (np.arange(width, dtype=np.float32) - step // 2) / step
    y = (np.arange(height, dtype=np.float32) - step // 2) / step
    x, y = np.meshgrid(x.clip(0, coarse[1] - 1), y.clip(0, coarse[0] - 1))
    return cv2.convertMaps(x, y, cv2.CV_16SC2)


def _log(depth: np.ndarray) -> np.ndarray:
    """Log depth, NaN without a prediction."""
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, np.log(np.where(known, depth, 1.0)), np.nan)


def _features(
    place: np.ndarray, logs: np.ndarray, middle: float, options: FieldOptions
) -> np.ndarray:
    """N x 3, in lengths of the kernel; `middle` stands for log depths that are unknown."""
    logs = np.where(np.isfinite(logs), logs, middle)
    return np.column_stack([place, _DEPTH * logs]) / options.length


def _kernel(first: np.ndarray, second: np.ndarray, options: FieldOptions) -> np.ndarray:
    """Covariance of the field between M and N places, M x N."""
    # -|a - b|^2 / 2 as one product: each further pass over M x N costs as much as the product.
    left, right = (-0.5 * (places**2).sum(axis=1, keepdims=True) for places in (first, second))
    found = np.hstack([first, left, np.ones_like(left)])
    found = found @ np.hstack([second, np.ones_like(right), right]).T
    np.exp(found, out=found)
    found *= options.deviation**2
    return np.asarray(found)


def _conditioned(
    kernel: np.ndarray, residuals: np.ndarray, noise: np.ndarray, misfit: np.ndarray
) -> np.ndarray:
    """The weights of the points (N), by iteratively reweighted least squares (Cauchy's)."""
    variance = noise**2
    for _ in range(_ROUNDS):
        factor = cho_factor(kernel + np.diag(variance), lower=True, check_finite=False)
        weights: np.ndarray = cho_solve(factor, residuals, check_finite=False)
        left = (residuals - kernel @ weights) / (_OUTLIER * misfit)
        variance = noise**2 * (1 + left**2)
    return weights
