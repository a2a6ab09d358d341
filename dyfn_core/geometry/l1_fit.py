"""The exact weighted L1 fit of a scale and a shift, for arrays with very many samples."""

from __future__ import annotations

import numpy as np

_SMALL = 4096  # problems up to this size are solved directly, larger ones are pruned first
_SAMPLE = 2048
_MAX_ITERATIONS = 200


def fit_scale_shift(
    prediction: np.ndarray, target: np.ndarray, weights: np.ndarray | None = None
) -> tuple[float, float]:
    """The (scale, shift) that minimise sum_i w_i |scale * prediction_i + shift - target_i|.

    The alignment of the video and image protocols (paper section 5, with w = 1 / target). Exact,
    not iteratively reweighted: the objective is convex and piecewise linear, its minimum is found
    by cutting planes in the scale with a weighted median for the shift. Large inputs are first
    solved on a sample; residuals that cannot change sign near that solution are collapsed into
    one linear term, and the result is accepted only when it lies strictly inside the region where
    that is exact.

    prediction, target, weights: any shape, the same number of elements; weights >= 0.
    Returns floats. A constant prediction gives scale 1. Raises ValueError on differing sizes,
    non-finite values, negative weights, or when no weight is positive.
    """
    x, y, w = _checked(prediction, target, weights)
    x0, y0 = np.median(x), np.median(y)
    x_unit = np.mean(np.abs(x - x0))
    y_unit = np.mean(np.abs(y - y0))
    if x_unit <= 1e-12 * max(1.0, abs(x0)):
        return 1.0, float(_weighted_median(y - x, w, 0.0))
    y_unit = y_unit if y_unit > 0 else 1.0
    scale, shift = _solve((x - x0) / x_unit, (y - y0) / y_unit, w / w.sum())
    scale = scale * y_unit / x_unit
    return float(scale), float(shift * y_unit + y0 - scale * x0)


def _checked(
    prediction: np.ndarray, target: np.ndarray, weights: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    x = np.asarray(prediction, np.float64).ravel()
    y = np.asarray(target, np.float64).ravel()
    w = np.ones_like(x) if weights is None else np.asarray(weights, np.float64).ravel()
    if not x.size == y.size == w.size:
        raise ValueError(
            f"prediction, target and weights must have as many elements as each other, "
            f"got {x.size}, {y.size} and {w.size}"
        )
    for name, values in (("prediction", x), ("target", y), ("weights", w)):
        if not np.isfinite(values).all():
            raise ValueError(f"{name} holds values that are not finite; mask them out first")
    if (w < 0).any():
        raise ValueError("weights must not be negative")
    used = w > 0
    if not used.any():
        raise ValueError("no sample has a positive weight: nothing to fit")
    return x[used], y[used], w[used]


def _solve(x: np.ndarray, y: np.ndarray, w: np.ndarray) -> tuple[float, float]:
    """Solve in normalised coordinates (x and y centred, of unit spread)."""
    if x.size <= _SMALL:
        return _minimise(x, y, w, 0.0, 0.0, (-np.inf, np.inf))
    chosen = np.random.default_rng(0).choice(x.size, _SAMPLE, replace=False)
    scale, shift = _solve(x[chosen], y[chosen], w[chosen])
    residual = np.abs(scale * x + shift - y)
    margin = 4 * float(np.median(residual)) / np.sqrt(_SAMPLE) + 1e-9
    while True:
        uncertain = residual <= margin * (np.abs(x) + 1)
        if uncertain.mean() > 0.5:
            return _minimise(x, y, w, 0.0, 0.0, (-np.inf, np.inf))
        sure = ~uncertain
        signed = w[sure] * np.sign(scale * x[sure] + shift - y[sure])
        bounds = (scale - margin, scale + margin)
        s, t = _minimise(
            x[uncertain],
            y[uncertain],
            w[uncertain],
            float(signed @ x[sure]),
            float(signed.sum()),
            bounds,
        )
        inside = max(abs(s - scale), abs(t - shift)) < 0.99 * margin
        if inside and abs(signed.sum()) < w[uncertain].sum():
            return s, t
        margin *= 4


def _minimise(
    x: np.ndarray,
    y: np.ndarray,
    w: np.ndarray,
    slope_s: float,
    slope_t: float,
    bounds: tuple[float, float],
) -> tuple[float, float]:
    """argmin over s in bounds and t of sum w |s x + t - y| + slope_s s + slope_t t.

    Cutting planes on g(s) = min_t f(s, t): the next s is where the tangents at the ends of the
    bracket meet; when g there is what the tangents promise, it is the minimum. Every third step
    halves the bracket instead, so that it always shrinks.
    """

    weighted = w * x

    def probe(s: float) -> tuple[float, float, float]:
        offset = y - s * x
        t = _weighted_median(offset, w, slope_t)
        residual = t - offset
        size = np.abs(residual)
        tied = (size <= 1e-12).nonzero()[0]
        sign = np.sign(residual)
        sign[tied] = 0.0
        if tied.size:
            balance = -float(w @ sign + slope_t) / float(w[tied].sum())
            sign[tied] = min(max(balance, -1.0), 1.0)
        value = float(w @ size) + slope_s * s + slope_t * t
        return value, float(weighted @ sign) + slope_s, t

    low, high = _bracket(probe, bounds)
    best = min(low, high, key=lambda end: end[1][0])
    for step in range(_MAX_ITERATIONS):
        (a, (value_a, slope_a, _)), (b, (value_b, slope_b, _)) = low, high
        if slope_a >= 0 or slope_b <= 0 or b - a <= 1e-15 * max(1.0, abs(a), abs(b)):
            break
        meet = (value_a - value_b + slope_b * b - slope_a * a) / (slope_b - slope_a)
        promised = value_a + slope_a * (meet - a)
        middle = meet if step % 3 < 2 and a < meet < b else 0.5 * (a + b)
        found = (middle, probe(middle))
        if found[1][0] < best[1][0]:
            best = found
        if best[1][0] <= promised + 1e-15 * abs(promised) or found[1][1] == 0:
            break
        if found[1][1] < 0:
            low = found
        else:
            high = found
    return best[0], best[1][2]


def _bracket(probe, bounds: tuple[float, float]):  # type: ignore[no-untyped-def]
    """Two scales with their probes, the slope of g <= 0 at the first and >= 0 at the second."""
    if np.isfinite(bounds[0]):
        return (bounds[0], probe(bounds[0])), (bounds[1], probe(bounds[1]))
    step = 1.0
    low = (0.5, probe(0.5))
    while low[1][1] > 0:
        low = (low[0] - step, probe(low[0] - step))
        step *= 2
    step = 1.0
    high = (1.0, probe(1.0))
    while high[1][1] < 0:
        high = (high[0] + step, probe(high[0] + step))
        step *= 2
    return low, high


def _weighted_median(values: np.ndarray, weights: np.ndarray, slope: float) -> float:
    """argmin over t of sum w |t - values| + slope * t (slope within the total weight)."""
    order = values.argsort()  # as a method: np.argsort takes longer than sorting a few values
    cumulative = weights[order].cumsum()
    index = int(cumulative.searchsorted(0.5 * (cumulative[-1] - slope)))
    return float(values[order[min(index, values.size - 1)]])
