"""Transforms between frames by value, and the errors that name frames."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_core.geometry.rigid import inverse, rigid
from dyfn_core.metric.pose_history import GAP, JUMP, LATE, NoPose, Placed
from dyfn_ros.messages.transforms import TransformBuffer, TransformError
from tests.support.odometry import MOUNT, SECOND, base_pose, tf_message, transform

CAMERA, ARM = "camera_optical", "arm"
LIDAR = rigid(np.eye(3), np.array([0.1, 0.0, 0.8]))


def robot(until: float = 2.0) -> TransformBuffer:
    """odom -> base_link moves; base_link -> mast -> camera and base_link -> lidar are static."""
    buffer = TransformBuffer()
    mast = rigid(np.eye(3), np.array([0, 0, 0.4]))
    static = tf_message(
        transform(mast, 0, "base_link", "mast"),
        transform(inverse(mast) @ MOUNT, 0, "mast", f"/{CAMERA}"),
        transform(LIDAR, 0, "base_link", "lidar"),
    )
    buffer.take(static, static=True)
    for time in np.arange(0, until, 0.05):
        buffer.take(tf_message(transform(base_pose(time), time, "odom", "base_link")), static=False)
    return buffer


def pose(buffer: TransformBuffer, target: str, source: str, seconds: float) -> np.ndarray:
    found = buffer.lookup(target, source, round(seconds * SECOND))
    assert isinstance(found, Placed), found
    return found.pose


def test_the_camera_on_a_circle() -> None:
    for time in (0.0, 0.5, 1.234):
        found = pose(robot(), "odom", CAMERA, time)
        np.testing.assert_allclose(found, base_pose(time) @ MOUNT, atol=1e-4)
        np.testing.assert_allclose(pose(robot(), CAMERA, "odom", time), inverse(found), atol=1e-12)


def test_by_a_common_ancestor_the_motion_does_not_matter() -> None:
    buffer = robot()
    np.testing.assert_allclose(
        pose(buffer, CAMERA, "lidar", 99.0), inverse(MOUNT) @ LIDAR, atol=1e-12
    )
    assert not buffer.moves(CAMERA, "lidar")
    assert buffer.moves("odom", "lidar")
    np.testing.assert_array_equal(pose(buffer, CAMERA, CAMERA, 0.0), np.eye(4))


def test_what_has_not_come_is_waited_for() -> None:
    buffer = robot(1.0)
    assert buffer.reaches("odom", CAMERA, round(0.9 * SECOND))
    assert not buffer.reaches("odom", CAMERA, round(1.1 * SECOND))
    found = buffer.lookup("odom", CAMERA, round(1.1 * SECOND))
    assert isinstance(found, NoPose)
    assert found.reason == LATE and "base_link in odom: the newest pose is" in found.detail


def test_frames_that_are_not_there_are_named() -> None:
    with pytest.raises(TransformError, match=r"no frame 'cam' \(it has: base_link, camera_optical"):
        robot().lookup("odom", "cam", 0)
    with pytest.raises(TransformError, match=r"no frame 'b' \(it has: none\)"):
        TransformBuffer().lookup("a", "b", 0)


def test_trees_that_are_apart_are_named() -> None:
    buffer = robot()
    buffer.take(tf_message(transform(np.eye(4), 0, "world", "other")), static=True)
    text = r"connect 'other' \(below 'world'\) with 'base_link' \(below 'odom'\)"
    with pytest.raises(TransformError, match=text):
        buffer.lookup("base_link", "other", 0)


def test_a_circle_is_named() -> None:
    buffer = TransformBuffer()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        buffer.take(tf_message(transform(np.eye(4), 0, parent, child)), static=True)
    with pytest.raises(TransformError, match="circle: b -> a -> c -> b"):
        buffer.lookup("a", "b", 0)


def test_a_frame_that_moves_and_is_static_moves() -> None:
    buffer = robot()
    buffer.take(tf_message(transform(np.eye(4), 0, "odom", "base_link")), static=True)
    np.testing.assert_allclose(pose(buffer, "odom", "base_link", 1.0), base_pose(1.0), atol=1e-9)


def test_a_new_parent_takes_the_place_of_the_old_one() -> None:
    buffer = robot(1.0)
    for time in np.arange(1.0, 2.0, 0.05):
        buffer.take(tf_message(transform(np.eye(4), time, "map", "base_link")), static=False)
    np.testing.assert_array_equal(pose(buffer, "map", "base_link", 1.5), np.eye(4))
    with pytest.raises(TransformError, match="no frame 'odom'"):
        buffer.lookup("odom", "base_link", 0)


def test_bad_transforms_cost_themselves_alone() -> None:
    buffer = robot(1.0)
    bad = transform(base_pose(1.0), 1.0, "odom", "base_link")
    bad.transform.rotation.w = float("nan")
    buffer.take(tf_message(bad, transform(MOUNT, 0, "base_link", "second")), static=False)
    assert buffer.counts == {"base_link: the pose has values that are not finite": 1}
    np.testing.assert_allclose(pose(buffer, "base_link", "second", 0.0), MOUNT, atol=1e-12)
    buffer.take(tf_message(transform(MOUNT, 0, "self", "self")), static=True)
    assert buffer.counts["self: a transform from 'self' to 'self'"] == 1


def test_a_jump_is_counted_where_it_matters() -> None:
    buffer = robot(1.0)
    away = rigid(np.eye(3), np.array([0, 9.0, 0]))
    buffer.take(tf_message(transform(away, 1.0, "odom", "base_link")), static=False)
    buffer.take(tf_message(transform(away, 1.0, "odom", "base_link")), static=False)
    assert buffer.unused("odom", CAMERA) == {JUMP: 1}
    assert buffer.unused("base_link", CAMERA) == {}


def test_a_gap_is_not_bridged() -> None:
    buffer = robot(1.0)
    buffer.take(tf_message(transform(base_pose(3), 3.0, "odom", "base_link")), static=False)
    found = buffer.lookup("odom", CAMERA, round(2 * SECOND))
    assert isinstance(found, NoPose) and found.reason == GAP
