"""Messages of odometry by value: poses, frames, and what their covariances say."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.odometry import ErrorGrowth, decode_body_pose
from dyfn_ros.messages.odometry_options import ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM
from tests.support.odometry import (
    base_pose,
    odometry,
    pose_stamped,
    pose_with_covariance,
    transform,
)

ONES = np.ones(6)


def test_each_type_gives_stamp_frames_and_pose() -> None:
    pose, at = base_pose(3.0), 3.25
    made = {
        ODOMETRY: (odometry(pose, at, "/odom"), "base_link"),
        POSE: (pose_stamped(pose, at), ""),
        POSE_COVARIANCE: (pose_with_covariance(pose, at, 0.01 * ONES), ""),
        TRANSFORM: (transform(pose, at, "odom", "/body"), "body"),
    }
    for kind, (message, child) in made.items():
        found = decode_body_pose(message, kind)
        assert (found.stamp, found.frame, found.child) == (3_250_000_000, "odom", child)
        np.testing.assert_allclose(found.pose, pose, atol=1e-12)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"x": float("nan")}, "not finite"),
        ({"qw": float("inf")}, "not finite"),
        ({"qw": 0.0}, "length 0, expected 1"),
        ({"qw": 2.0}, "length 2, expected 1"),
    ],
)
def test_what_is_no_pose_is_refused(values: dict[str, float], text: str) -> None:
    message = odometry(np.eye(4), 1.0)
    message.pose.pose.position.x = values.get("x", 0.0)
    message.pose.pose.orientation.w = values.get("qw", 1.0)
    with pytest.raises(MessageError, match=text):
        decode_body_pose(message, ODOMETRY)


def test_a_quaternion_with_rounding_errors_is_normalised() -> None:
    message = odometry(base_pose(1), 1.0)
    message.pose.pose.orientation.w *= 1.005
    message.pose.pose.orientation.z *= 1.005
    np.testing.assert_allclose(decode_body_pose(message, ODOMETRY).pose, base_pose(1), atol=1e-12)


def growths(
    covariances: list[np.ndarray | None], twists: list[np.ndarray | None] | None = None
) -> tuple[list[tuple[float, float] | None], str]:
    """Every 0.1 s; and what they are from."""
    growth, found = ErrorGrowth(), []
    for step, covariance in enumerate(covariances):
        twist = None if twists is None else twists[step]
        message = odometry(np.eye(4), 0.1 * step, covariance=covariance, twist=twist)
        found.append(growth.push(decode_body_pose(message, ODOMETRY)))
    return found, growth.source


def test_a_covariance_that_grows_says_how_much_the_step_errs() -> None:
    step = np.array([1, 2, 3, 10, 20, 30]) * 1e-6
    found, source = growths([step * n for n in range(1, 5)])
    assert found[0] == (0, 0)
    for one in found[1:]:
        assert one == pytest.approx((2e-5, 2e-6))
    assert source == "pose covariance"


def test_axes_that_a_planar_robot_declares_unknown_are_constant() -> None:
    junk = np.array([0, 0, 1e6, 1e6, 1e6, 0])
    found, _ = growths([junk + np.array([3, 0, 0, 0, 0, 6]) * 1e-6 * n for n in range(1, 4)])
    assert found[1] == pytest.approx((2e-6, 1e-6))


def test_a_correction_is_no_growth() -> None:
    found, _ = growths([ONES * 1e-4 * n for n in (1, 2, 1, 1.5)])
    assert found[1:] == [pytest.approx((g, g)) for g in (1e-4, 0, 0.5e-4)]


def test_a_constant_covariance_says_nothing() -> None:
    found, source = growths([ONES * 1e-3] * 3)
    assert found[1:] == [None, None]
    assert source == "none"


def test_velocities_err_each_for_itself() -> None:
    """Of a standard deviation of 2 cm/s, a step of 0.1 s has one of 2 mm."""
    twist = np.array([4e-4, 4e-4, 1e6, 1e6, 0, 9e-4])
    found, source = growths([ONES * 1e-3] * 3, [twist] * 3)
    assert found[2] == pytest.approx((9e-6, 4e-6))
    assert source == "twist covariance"


@pytest.mark.parametrize(
    "twist", [np.zeros(6), -ONES, np.full(6, np.nan), np.array([1e-4, 1e-4, 1e-4, 1e6, 1e6, 1e6])]
)
def test_a_covariance_that_is_not_there_is_not_used(twist: np.ndarray) -> None:
    found, source = growths([None] * 3, [twist] * 3)
    assert found[1:] == [None, None]
    assert source == "none"
