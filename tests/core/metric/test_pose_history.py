"""The pose of a moment out of stamped poses, and why there is none."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from dyfn_core.geometry.rigid import quaternion_rotation, rigid
from dyfn_core.metric import pose_history as reasons
from dyfn_core.metric.pose_history import NoPose, Placed, PoseHistory
from dyfn_core.metric.pose_limits import PoseLimits

START = 1_700_000_000_000_000_000  # float64 seconds would be 240 ns off here


def ns(seconds: float) -> int:
    return START + round(seconds * 1e9)


def circle(seconds: float, radius: float = 2.0, rate: float = 0.3) -> np.ndarray:
    """On a circle in the plane, looking along the way."""
    angle = rate * seconds
    rotation = quaternion_rotation(np.cos(angle / 2), 0, 0, np.sin(angle / 2))
    return rigid(rotation, radius * np.array([np.sin(angle), 1 - np.cos(angle), 0]))


def along(seconds: float, speed: float = 0.5) -> np.ndarray:
    return rigid(np.eye(3), np.array([speed * seconds, 0, 0]))


def filled(times: np.ndarray | list[float], **limits: float) -> PoseHistory:
    history = PoseHistory(PoseLimits(**limits))  # type: ignore[arg-type]
    for time in times:
        assert history.add(ns(time), along(time)) is None
    return history


def placed(history: PoseHistory, seconds: float) -> Placed:
    found = history.at(ns(seconds))
    assert isinstance(found, Placed), found
    return found


def missing(history: PoseHistory, seconds: float) -> NoPose:
    found = history.at(ns(seconds))
    assert isinstance(found, NoPose)
    return found


def test_a_pose_between_two_is_interpolated() -> None:
    history = PoseHistory()
    for step in range(100):
        history.add(ns(0.02 * step), circle(0.02 * step))
    for time in (0.0, 0.02, 0.0317, 1.23456, 1.98):
        np.testing.assert_allclose(placed(history, time).pose, circle(time), atol=1e-5)


def test_stamps_are_whole_nanoseconds() -> None:
    """100 ns of a way at 1 km/s are 0.1 mm, which seconds as float64 would not tell apart."""
    history = PoseHistory(PoseLimits(speed=1e4))
    history.add(START, along(0, 1000))
    history.add(START + 1000, along(1e-6, 1000))
    found = history.at(START + 100)
    assert isinstance(found, Placed)
    assert found.pose[0, 3] == pytest.approx(1e-4, rel=1e-9)


def test_the_order_of_arrival_does_not_matter() -> None:
    times = np.arange(0, 1, 0.05)
    shuffled = times.copy()
    for i in range(0, len(times) - 1, 2):
        shuffled[[i, i + 1]] = shuffled[[i + 1, i]]
    one, other = filled(times), filled(shuffled)
    for time in np.arange(0.06, 0.9, 0.013):
        np.testing.assert_array_equal(placed(one, time).pose, placed(other, time).pose)


def test_a_moment_does_not_change_when_later_poses_come() -> None:
    history = filled([0, 0.1, 0.2])
    before = placed(history, 0.13).pose
    assert history.reaches(ns(0.13)) and not history.reaches(ns(0.21))
    history.add(ns(0.3), circle(9))
    np.testing.assert_array_equal(placed(history, 0.13).pose, before)


def test_beyond_the_ends_the_motion_goes_on_for_the_tolerance() -> None:
    history = filled([0, 0.1, 0.2], tolerance=0.05)
    for time in (0.24, -0.04):
        np.testing.assert_allclose(placed(history, time).pose, along(time), atol=1e-12)
    assert missing(history, 0.26).reason == reasons.LATE
    assert missing(history, -0.06).reason == reasons.BEFORE
    alone = filled([0])
    np.testing.assert_array_equal(placed(alone, 0.04).pose, along(0))


def test_nothing_has_come_yet() -> None:
    assert missing(PoseHistory(), 0).reason == reasons.NONE_YET


def test_a_gap_is_not_bridged() -> None:
    history = filled([0, 0.1, 0.8, 0.9])
    found = missing(history, 0.4)
    assert (found.reason, "0.7 s apart" in found.detail) == (reasons.GAP, True)
    np.testing.assert_allclose(placed(history, 0.12).pose, along(0.12), atol=1e-12)


@pytest.mark.parametrize(
    ("offset", "text"),
    [
        (-3600.0, "3600 s older"),
        (-5.0, "5.0 s older"),
        (5.0, "5.0 s younger"),
        (3600.0, "3600 s younger"),
    ],
)
def test_another_clock_is_named_with_its_offset(offset: float, text: str) -> None:
    history = PoseHistory()
    for step in range(1, 20):
        history.add(ns(offset + 0.05 * step), along(0.05 * step))
        found = missing(history, 0.05 * step)
        assert found.reason == reasons.OTHER_CLOCK
        assert f"the newest pose is {text} than the image" in found.detail


def test_poses_that_stopped_are_stale_and_no_clock() -> None:
    history = filled([0, 0.1])
    found = [missing(history, time).reason for time in (0.4, 2.0, 60.0)]
    assert found == [reasons.LATE, reasons.STALE, reasons.STALE]
    assert "60 s older" in missing(history, 60.1).detail


def test_a_loop_ends_the_history_before_it() -> None:
    history = filled(np.arange(0, 5, 0.1))
    again = history.add(ns(0.0), along(0.0))
    assert again is not None and again.reason == reasons.WENT_BACK
    assert "4.9 s" in again.detail
    assert history.add(ns(0.1), along(0.1)) is None
    np.testing.assert_allclose(placed(history, 0.05).pose, along(0.05), atol=1e-12)
    assert missing(history, 4.85).reason != reasons.LATE
    assert history.counts == {reasons.WENT_BACK: 1}


def test_a_jump_is_not_interpolated_across() -> None:
    history = PoseHistory(PoseLimits(speed=5.0, tolerance=0.03))
    away = rigid(np.eye(3), np.array([0, 3.0, 0]))
    for step in range(10):
        found = history.add(ns(0.1 * step), (away if step >= 5 else np.eye(4)) @ along(0.1 * step))
        assert (found is not None) == (step == 5)
    assert missing(history, 0.45).reason == reasons.JUMP
    np.testing.assert_allclose(placed(history, 0.42).pose, along(0.42), atol=1e-12)
    np.testing.assert_allclose(placed(history, 0.48).pose, away @ along(0.48), atol=1e-12)
    np.testing.assert_allclose(placed(history, 0.55).pose, away @ along(0.55), atol=1e-12)
    assert history.counts == {reasons.JUMP: 1}


def test_a_turn_that_is_too_fast_is_a_jump() -> None:
    history = PoseHistory()
    history.add(ns(0), circle(0, 0))
    found = history.add(ns(0.02), circle(0.02, 0, rate=30))
    assert found is not None
    assert (found.reason, "rad/s" in found.detail) == (reasons.JUMP, True)


def test_stamps_that_jitter_are_no_jump() -> None:
    """Two messages 0.1 ms apart whose poses are 1 cm apart."""
    history = PoseHistory()
    history.add(ns(0), along(0))
    assert history.add(ns(1e-4), along(0.02)) is None


@pytest.mark.parametrize(
    "pose",
    [np.full((4, 4), np.nan), np.diag([2.0, 1, 1, 1]), np.diag([1.0, 1, -1, 1])],
)
def test_what_is_no_rigid_pose_is_counted(pose: np.ndarray) -> None:
    history = filled([0])
    found = history.add(ns(0.1), pose)
    assert found is not None and found.reason == reasons.NO_POSE
    assert history.newest == ns(0)
    assert history.counts == {reasons.NO_POSE: 1}


def test_of_two_poses_with_one_stamp_the_first_counts() -> None:
    history = filled([0, 0.1])
    found = history.add(ns(0.1), along(5))
    assert found is not None and found.reason == reasons.DUPLICATE
    np.testing.assert_array_equal(placed(history, 0.1).pose, along(0.1))


def test_the_oldest_poses_make_room() -> None:
    history = PoseHistory(PoseLimits(capacity=100))
    for step in range(1000):
        history.add(ns(0.01 * step), along(0.01 * step))
        assert len(history._stamps) <= 100
    assert missing(history, 3.0).reason == reasons.GONE
    np.testing.assert_allclose(placed(history, 9.2).pose, along(9.2), atol=1e-12)


def test_variances_are_summed_up_along_the_way() -> None:
    history = PoseHistory()
    for step in range(5):
        history.add(ns(0.1 * step), along(0.1 * step), (1e-6, 4e-6) if step else (0, 0))
    found = placed(history, 0.25).variance
    assert found == pytest.approx((2.5e-6, 1e-5))
    history.add(ns(0.5), along(0.5), None)
    assert placed(history, 0.45).variance is None
    history.add(ns(0.6), along(0.6), (1e-6, 4e-6))
    assert placed(history, 0.6).variance == pytest.approx((5e-6, 2e-5))


def test_a_jump_counts_as_an_error_of_its_size() -> None:
    history = PoseHistory()
    history.add(ns(0), along(0), (0, 0))
    history.add(ns(0.1), along(6), (1e-6, 1e-6))
    found = placed(history, 0.1).variance
    assert found is not None
    assert found == pytest.approx((1e-6, 3.0**2 / 3), rel=1e-4)


def test_the_caller_may_write_to_what_it_gave_and_got() -> None:
    history = PoseHistory()
    pose = along(0)
    history.add(ns(0), pose)
    pose[0, 3] = 99
    placed(history, 0).pose[1, 3] = 99
    np.testing.assert_array_equal(placed(history, 0).pose, along(0))


def test_poses_may_come_from_another_thread() -> None:
    history, found, read = PoseHistory(), [], threading.Event()

    def write() -> None:
        for step in range(3000):
            if step == 1500:
                read.wait(30)  # on a busy machine the reader may come late
            history.add(ns(0.01 * step), along(0.01 * step))

    thread = threading.Thread(target=write)
    thread.start()
    while thread.is_alive():
        newest = history.newest
        if newest is not None and newest > START:
            found.append((history.at(newest - 5_000_000), newest))
            read.set()
    thread.join()
    assert found
    for pose, newest in found:
        assert isinstance(pose, Placed)
        seconds = (newest - 5_000_000 - START) * 1e-9
        np.testing.assert_allclose(pose.pose, along(seconds), atol=1e-9)
