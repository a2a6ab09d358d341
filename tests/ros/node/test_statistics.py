"""Rates, latencies and counts of frames."""

from __future__ import annotations

import pytest

from dyfn_ros.node.statistics import FrameStatistics


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_rates_are_of_the_time_since_the_snapshot_before() -> None:
    clock = Clock()
    statistics = FrameStatistics(clock)
    for _ in range(20):
        statistics.count("received")
    for _ in range(10):
        statistics.published(0.05, 0.04)
    clock.now = 2.0
    first = statistics.snapshot()
    assert (first.input_rate, first.output_rate) == (10.0, 5.0)
    statistics.count("bad")
    clock.now = 3.0
    second = statistics.snapshot()
    assert (second.input_rate, second.output_rate, second.recent) == (0.0, 0.0, {"bad": 1})
    assert second.counts == {"received": 20, "published": 10, "bad": 1}


def test_latency_is_median_and_ninety_ninth_of_a_hundred() -> None:
    statistics = FrameStatistics(Clock())
    for index in range(101):
        statistics.published(index * 1e-3, index * 2e-3)
    snapshot = statistics.snapshot()
    assert snapshot.latency == pytest.approx((0.050, 0.099))
    assert snapshot.processing == pytest.approx((0.100, 0.198))
    assert snapshot.same_clock


def test_nothing_is_known_before_the_first_frame() -> None:
    snapshot = FrameStatistics(Clock()).snapshot()
    assert (snapshot.latency, snapshot.processing, snapshot.same_clock) == (None, None, True)


def test_stamps_of_another_clock_are_noticed() -> None:
    statistics = FrameStatistics(Clock())
    statistics.published(1.7e9, 0.01)
    assert not statistics.snapshot().same_clock
