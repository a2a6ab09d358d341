"""Robust scale fits: right with few points and many outliers, and honest when they cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyfn_core.metric.fit import (
    MetricMap,
    NoFitError,
    fit_scale,
    fit_scale_and_shift,
    robust_centre,
)

scales = st.floats(1e-2, 1e2)
counts = st.integers(10, 20)
seeds = st.integers(0, 2**32 - 1)
# Outliers: what is wrong in real references is off by half as much again, or more, on either side.
outlier_factors = st.sampled_from([0.1, 0.4, 0.6, 1.7, 3.0, 20.0])


def points(
    rng: np.random.Generator, count: int, scale: float, noise: float, shift: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    predicted = rng.uniform(0.5, 5, count)
    measured = (scale * predicted + shift) * np.exp(noise * rng.standard_normal(count).clip(-2, 2))
    return predicted, measured


@settings(max_examples=150, deadline=None)
@given(counts, scales, st.floats(0, 0.4), outlier_factors, st.booleans(), seeds)
def test_scale_survives_up_to_forty_percent_outliers_in_ten_to_twenty_points(
    count: int, scale: float, share: float, factor: float, scattered: bool, seed: int
) -> None:
    """Whether the outliers agree with each other (a pane of glass) or not (noise)."""
    rng = np.random.default_rng(seed)
    predicted, measured = points(rng, count, scale, noise=0.03)
    wrong = rng.choice(count, int(share * count), replace=False)
    spread = np.exp(rng.uniform(-0.1, 0.1, len(wrong))) if scattered else 1.0
    measured[wrong] *= factor * spread
    fit = fit_scale(predicted, measured)
    assert abs(np.log(fit.map.scale / scale)) < 0.06
    assert 2 * fit.inliers >= count
    assert fit.total == count
    assert fit.spread < 0.1


@settings(max_examples=40, deadline=None)
@given(counts, scales, scales, seeds)
def test_scale_follows_the_units_of_both_sides(
    count: int, unit: float, other: float, seed: int
) -> None:
    predicted, measured = points(np.random.default_rng(seed), count, 1.0, noise=0.05)
    plain = fit_scale(predicted, measured).map.scale
    scaled = fit_scale(predicted * unit, measured * other).map.scale
    np.testing.assert_allclose(scaled, plain * other / unit, rtol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 20), st.floats(-0.08, 2.0), st.floats(0, 0.3), seeds)
def test_scale_and_shift_are_both_found_despite_outliers(
    scale: float, shift: float, share: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    predicted = np.linspace(0.5, 5, 20)
    measured = (scale * predicted + shift) * np.exp(0.01 * rng.standard_normal(20).clip(-2, 2))
    wrong = rng.choice(20, int(share * 20), replace=False)
    measured[wrong] *= rng.choice([0.3, 2.5], len(wrong))
    found = fit_scale_and_shift(predicted, measured)
    middle = np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(found.map(middle), scale * middle + shift, rtol=0.05)


def test_scale_alone_is_wrong_where_there_is_a_shift_and_the_other_fit_is_not() -> None:
    predicted = np.linspace(0.5, 4, 15)
    measured = 2 * predicted + 1
    both = fit_scale_and_shift(predicted, measured).map
    assert (both.scale, both.shift) == pytest.approx((2, 1), abs=1e-6)
    assert fit_scale(predicted, measured).spread > 0.06


@pytest.mark.parametrize("fit", [fit_scale, fit_scale_and_shift])
def test_too_few_points_are_no_fit(fit) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(NoFitError, match="9 points, needs 10"):
        fit(np.ones(9), np.ones(9))


def test_points_without_a_common_scale_are_no_fit() -> None:
    predicted = np.ones(12)
    measured = np.geomspace(0.01, 100, 12)
    with pytest.raises(NoFitError, match=r"agree on one scale|spread by"):
        fit_scale(predicted, measured)


def test_points_at_one_depth_give_a_scale_but_no_shift() -> None:
    predicted, measured = np.full(12, 2.0), np.full(12, 3.0)
    assert fit_scale(predicted, measured).map.scale == pytest.approx(1.5)
    with pytest.raises(NoFitError, match="tell a shift from a scale"):
        fit_scale_and_shift(predicted, measured)


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_values_that_are_no_depth_are_refused(bad: float) -> None:
    good = np.ones(12)
    broken = good.copy()
    broken[3] = bad
    with pytest.raises(ValueError, match="finite and positive"):
        fit_scale(broken, good)
    with pytest.raises(ValueError, match="finite and positive"):
        fit_scale(good, broken)


def test_robust_centre_of_a_normal_sample_is_its_mean_and_deviation() -> None:
    values = np.random.default_rng(0).normal(3.0, 0.2, 4000)
    centre, spread, kept = robust_centre(values)
    assert centre == pytest.approx(3.0, abs=0.02)
    assert spread == pytest.approx(0.2, rel=0.05)
    assert 0.97 < kept.mean() <= 1


def test_map_turns_depth_into_metres() -> None:
    np.testing.assert_array_equal(MetricMap(2.0, 0.5)(np.array([1.0, 2.0])), [2.5, 4.5])
