"""The scale of a stream over time: a slow metric scale and a deviation that returns to zero."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

_UNKNOWN = 9.0  # variance of a log scale that nothing is known of
_OUTLIER = 3.0  # standard deviations beyond which an innovation loses weight


@dataclass(frozen=True)
class FilterOptions:
    """The two states' dynamics.

    Attributes:
        drift: random walk of the stream's log scale, per square root of a second.
        deviation: standard deviation of a frame's deviation from it.
        seconds: time in which a deviation falls to 1 / e.
        another_stream: standard deviation between the log scales of two streams of one camera,
            for what is known of the scale after a reset.
    """

    drift: float = 0.009
    deviation: float = 0.35
    seconds: float = 0.5
    another_stream: float = 0.2


@dataclass(frozen=True)
class FilterState:
    """What is known of the scale at one time; a value.

    Attributes:
        mean: 2, of the stream's log scale and of the frame's deviation from it.
        covariance: 2 x 2, of the same.
        stamp: seconds; None when the time since then is unknown.
    """

    mean: np.ndarray
    covariance: np.ndarray
    stamp: float | None

    @property
    def log_scale(self) -> float:
        """Of the frame at `stamp`: metres in one unit of the stream, natural logarithm."""
        return float(self.mean.sum())

    @property
    def sigma(self) -> float:
        """Standard deviation of log_scale."""
        return math.sqrt(float(self.covariance.sum()))


def predict(state: FilterState, stamp: float, options: FilterOptions) -> FilterState:
    """The state at a later time, without a measurement: the deviation returns to zero.

    Args:
        state: it is not changed.
        stamp: seconds; an earlier one than the state's counts as the state's.
        options: see FilterOptions.
    """
    before = stamp if state.stamp is None else state.stamp
    elapsed = max(stamp - before, 0.0)
    keep = math.exp(-elapsed / options.seconds)
    step = np.diag([1.0, keep])
    covariance = step @ state.covariance @ step
    covariance[0, 0] += options.drift**2 * elapsed
    covariance[1, 1] += options.deviation**2 * (1 - keep**2)
    return FilterState(step @ state.mean, covariance, max(stamp, before))


def restarted(state: FilterState, options: FilterOptions) -> FilterState:
    """What is known after the stream was reset: the slow scale, less certain, and no deviation.

    Args:
        state: before the reset; it is not changed.
        options: see FilterOptions.
    """
    slow = float(state.covariance[0, 0]) + options.another_stream**2
    covariance = np.diag([slow, options.deviation**2])
    return replace(state, mean=np.array([state.mean[0], 0.0]), covariance=covariance, stamp=None)


def update(
    state: FilterState | None,
    stamp: float,
    log_scale: float,
    variance: float,
    options: FilterOptions,
) -> FilterState:
    """The state after a measurement of a frame's log scale.

    An innovation beyond three standard deviations loses weight.

    Args:
        state: None begins one with this measurement.
        stamp: of the frame, seconds.
        log_scale: log(metres / unit).
        variance: of its noise.
        options: see FilterOptions.
    """
    if state is None:
        prior = np.diag([_UNKNOWN, options.deviation**2])
        state = FilterState(np.array([log_scale, 0.0]), prior, stamp)
    state = predict(state, stamp, options)
    innovation = log_scale - state.log_scale
    expected = float(state.covariance.sum()) + variance
    excess = abs(innovation) / (_OUTLIER * math.sqrt(expected))
    if excess > 1:
        expected = float(state.covariance.sum()) + variance * excess**2
    gain = state.covariance.sum(axis=1) / expected
    covariance = state.covariance - np.outer(gain, state.covariance.sum(axis=0))
    return FilterState(state.mean + gain * innovation, covariance, state.stamp)
