"""Images thinned out to a rate, and who asks too often."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_ros.node.pace import Chatter, Pace


def taken(rate: float, stamps: np.ndarray) -> list[bool]:
    pace = Pace()
    return [pace.takes(rate, float(stamp), float(stamp)) for stamp in stamps]


@pytest.mark.parametrize(("camera", "rate"), [(30, 10), (30, 20), (30, 7), (100, 33), (15, 4)])
def test_the_rate_is_kept_over_time_though_stamps_jitter(camera: int, rate: int) -> None:
    jitter = np.random.default_rng(0).uniform(-0.1, 0.1, 20 * camera)
    found = sum(taken(rate, (np.arange(20 * camera) + jitter) / camera))
    assert found == pytest.approx(20 * rate, rel=0.02)


@pytest.mark.parametrize("rate", [0, 30, 50])
def test_a_rate_that_the_camera_does_not_pass_skips_nothing(rate: float) -> None:
    assert all(taken(rate, np.arange(300) / 30))


def test_nothing_is_made_up_for_after_a_pause() -> None:
    stamps = np.concatenate([np.arange(10), 100 + np.arange(10)]) / 10
    found = taken(5.0, stamps)
    assert found[:10] == [True, False] * 5
    assert found[10:] == [True, False] * 5


def test_stamps_that_go_back_begin_anew_and_equal_ones_go_by_arrival() -> None:
    pace = Pace()
    assert pace.takes(1.0, 100.0, 0.0)
    assert not pace.takes(1.0, 100.1, 0.1)
    assert pace.takes(1.0, 5.0, 0.2)
    for arrived, expected in ((0.3, False), (1.1, False), (1.2, True), (1.5, False)):
        assert pace.takes(1.0, 5.0, arrived) is expected


def test_who_asks_again_and_again_is_noticed() -> None:
    now = 0.0
    often = Chatter(3, 1.0, lambda: now)
    assert [often() for _ in range(5)] == [False, False, False, True, True]
    now = 0.5
    assert often()
    now = 2.0
    assert [often() for _ in range(4)] == [False, False, False, True]
