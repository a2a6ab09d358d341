"""The two-state filter of log scale."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dyfn_core.metric.scale_filter import FilterOptions, FilterState, predict, update

OPTIONS = FilterOptions()


def settled(value: float = 0.5, frames: int = 100) -> FilterState:
    """After many measurements of one log scale, 0.1 s apart."""
    state = None
    for i in range(frames):
        state = update(state, 0.1 * i, value, 0.05**2, OPTIONS)
    assert state is not None
    return state


def test_first_measurement_is_the_scale() -> None:
    state = update(None, 3.0, 0.7, 0.1**2, OPTIONS)
    assert state.log_scale == pytest.approx(0.7)
    assert state.stamp == 3.0
    assert state.sigma == pytest.approx(0.1, rel=0.01)  # the measurement's own


def test_returns_to_the_stream_s_scale_without_measurements() -> None:
    state = settled()
    for i in range(5):
        state = update(state, 10.0 + 0.1 * i, 0.9, 0.05**2, OPTIONS)
    assert state.log_scale == pytest.approx(0.9, abs=0.05)
    slow = float(state.mean[0])
    later = predict(state, state.stamp + OPTIONS.seconds, OPTIONS)
    assert later.log_scale - slow == pytest.approx((state.log_scale - slow) / math.e)
    end = predict(state, state.stamp + 60.0, OPTIONS)
    assert end.log_scale == pytest.approx(slow, abs=1e-9)
    assert abs(slow - 0.5) < 0.2


def test_uncertainty_grows_without_measurements() -> None:
    state = settled()
    sigmas = [predict(state, state.stamp + t, OPTIONS).sigma for t in (0.0, 0.5, 2.0, 600.0)]
    assert sigmas == sorted(sigmas)
    assert sigmas[2] == pytest.approx(OPTIONS.deviation, rel=0.1)
    assert sigmas[3] > sigmas[2]
    steps = predict(predict(state, state.stamp + 0.3, OPTIONS), state.stamp + 0.5, OPTIONS)
    assert steps.sigma == pytest.approx(sigmas[1])  # the way there does not matter


def test_outlier_loses_weight() -> None:
    state = settled()
    usual = update(state, state.stamp + 0.1, 0.6, 0.05**2, OPTIONS).log_scale - 0.5
    wrong = update(state, state.stamp + 0.1, 3.5, 0.05**2, OPTIONS).log_scale - 0.5
    assert 0 < usual < 0.1
    assert 0 < wrong < 15 * usual  # 30 times with full weight


def test_errors_are_as_large_as_stated() -> None:
    """The filter on its own model: normalised errors have a standard deviation of 1."""
    draw, errors, step = np.random.default_rng(0), [], 0.2
    keep = math.exp(-step / OPTIONS.seconds)
    for _ in range(200):
        slow, deviation, state = draw.normal(0, 1), draw.normal(0, OPTIONS.deviation), None
        for i in range(12):
            value = slow + deviation + draw.normal(0, 0.15)
            state = update(state, step * i, value, 0.15**2, OPTIONS)
            if i < 11:
                slow += draw.normal(0, OPTIONS.drift * math.sqrt(step))
                deviation = keep * deviation + draw.normal(
                    0, OPTIONS.deviation * math.sqrt(1 - keep**2)
                )
        assert state is not None
        errors.append((state.log_scale - slow - deviation) / state.sigma)
    # 200 errors fix the standard deviation within 5%; held-back outliers narrow it a little
    assert np.std(errors) == pytest.approx(1.0, abs=0.15)


def test_stamp_that_goes_back_does_not_shrink_the_uncertainty() -> None:
    state = settled()
    earlier = predict(state, state.stamp - 5.0, OPTIONS)
    assert earlier.sigma == state.sigma
    assert earlier.stamp == state.stamp
    assert update(state, state.stamp - 5.0, 0.5, 0.01, OPTIONS).stamp == state.stamp


def test_state_is_not_changed() -> None:
    state = settled()
    kept = state.mean.tobytes(), state.covariance.tobytes()
    update(predict(state, 99.0, OPTIONS), 99.0, 0.9, 0.01, OPTIONS)
    update(state, 99.0, 0.9, 0.01, OPTIONS)
    assert kept == (state.mean.tobytes(), state.covariance.tobytes())
