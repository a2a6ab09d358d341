"""The pose of an image by odometry, tf and parameters; and each bad input with its warning."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dyfn_core.geometry.rigid import inverse, rigid
from dyfn_core.metric.pose_history import JUMP, LATE, OTHER_CLOCK, WENT_BACK
from dyfn_ros.messages.camera_poses import (
    NO_FRAME,
    NOT_TIED,
    OTHER_FRAME,
    UNREADABLE,
    CameraPoses,
)
from dyfn_ros.messages.odometry_options import OdometryOptions
from dyfn_ros.messages.transforms import TransformBuffer
from tests.support.odometry import (
    CAMERA,
    MOUNT,
    SECOND,
    TIMES,
    base_pose,
    camera_pose,
    odometry,
    pose_stamped,
    pose_text,
    pose_with_covariance,
    tf_message,
    transform,
)

BY_PARAMETER = pose_text(MOUNT)


class Bench:
    def __init__(self, **options: Any) -> None:
        self.warnings: list[str] = []
        self.tf = TransformBuffer()
        self.poses = CameraPoses(OdometryOptions(**options), "/odom", self.tf, self.warnings.append)

    def mount(self) -> Bench:
        self.tf.take(tf_message(transform(MOUNT, 0, "base_link", CAMERA)), static=True)
        return self

    def drive(
        self, make: Callable[[np.ndarray, float], Any] = odometry, times: Any = TIMES
    ) -> Bench:
        for seconds in times:
            self.poses.take(make(base_pose(seconds), seconds))
        return self

    def at(self, seconds: float, frame_id: str = CAMERA) -> np.ndarray | None:
        found = self.poses.at(round(seconds * SECOND), frame_id)
        return None if found is None else found.pose

    def check(self, seconds: float) -> None:
        found = self.at(seconds)
        assert found is not None, self.warnings
        np.testing.assert_allclose(found, camera_pose(seconds), atol=1e-4)


def test_odometry_and_a_camera_placed_by_tf() -> None:
    bench = Bench().mount().drive()
    for seconds in (0.0, 0.55, 1.2345):
        bench.check(seconds)
    assert bench.poses.report()["camera's place"] == "tf"
    assert bench.poses.report()["frames"] == "base_link in odom"
    assert bench.warnings == [] and bench.poses.missing == {}


def test_odometry_and_a_camera_placed_by_parameter() -> None:
    bench = Bench(camera_pose=BY_PARAMETER).drive()
    bench.check(0.77)
    assert bench.poses.report()["camera's place"] == "camera_pose"
    assert not bench.poses.wants_transforms


def test_odometry_of_the_camera_itself() -> None:
    bench = Bench(moving_frame=CAMERA).drive(
        lambda pose, seconds: odometry(pose @ MOUNT, seconds, child="")
    )
    bench.check(0.5)
    assert "of 'camera_optical' itself" in bench.poses.report()["camera's place"]


@pytest.mark.parametrize("moving", ["", "base_link"])
def test_a_pose_that_names_no_frame(moving: str) -> None:
    """It is the camera's own unless moving_frame says whose it is."""
    bench = Bench(odometry_type="PoseStamped", moving_frame=moving).mount()
    mount = np.eye(4) if moving else MOUNT
    bench.drive(lambda pose, seconds: pose_stamped(pose @ mount, seconds))
    bench.check(0.5)
    place = bench.poses.report()["camera's place"]
    assert place == "tf" if moving else "names no frame: taken for the camera's own" in place


def test_a_transform_stamped_and_a_pose_with_covariance() -> None:
    bench = Bench(odometry_type="TransformStamped").mount()
    bench.drive(lambda pose, seconds: transform(pose, seconds, "odom", "base_link"))
    bench.check(0.5)
    bench = Bench(odometry_type="PoseWithCovarianceStamped", camera_pose=BY_PARAMETER)
    growing = np.array([1, 1, 1, 2, 2, 2]) * 1e-6
    bench.drive(
        lambda pose, seconds: pose_with_covariance(pose, seconds, growing * (1 + 20 * seconds))
    )
    found = bench.poses.at(SECOND, CAMERA)
    assert found is not None and found.variance is not None
    np.testing.assert_allclose(found.pose, camera_pose(1.0), atol=1e-9)
    lever = 0.3**2 + 0.5**2  # errors of rotation move the camera
    assert found.variance == pytest.approx((4e-5, 2e-5 + 4e-5 * lever * 2 / 3))


@pytest.mark.parametrize("by_parameter", [False, True])
def test_tf_alone(by_parameter: bool) -> None:
    own = {"moving_frame": "base_link", "camera_pose": BY_PARAMETER} if by_parameter else {}
    bench = Bench(odometry_type="TF", **own)
    if not by_parameter:
        bench.mount()
    for seconds in TIMES:
        sent = transform(base_pose(seconds), seconds, "odom", "base_link")
        bench.tf.take(tf_message(sent), static=False)
    bench.check(1.01)
    assert bench.poses.topic == "/tf"
    assert bench.poses.reaches(SECOND, CAMERA) and not bench.poses.reaches(9 * SECOND, CAMERA)


def test_tf_that_does_not_move_is_no_odometry() -> None:
    bench = Bench(odometry_type="TF").mount()
    bench.tf.take(tf_message(transform(np.eye(4), 0, "odom", "base_link")), static=True)
    assert bench.at(1.0) is None
    assert "nothing on /tf moves 'camera_optical' in 'odom'" in bench.warnings[0]


def test_no_camera_is_taken_to_be_the_base() -> None:
    bench = Bench().drive()
    assert bench.at(0.5) is None
    assert bench.poses.missing == {NOT_TIED: 1}
    for word in ("/odom: no pose", "'base_link'", "'camera_optical'", "set camera_pose"):
        assert word in bench.warnings[0]
    assert bench.poses.problems() == bench.warnings
    bench.mount().check(0.5)
    assert bench.poses.problems() == []


def test_frames_without_names_are_refused() -> None:
    bench = Bench().mount().drive(lambda pose, seconds: odometry(pose, seconds, child=""))
    assert bench.at(0.5) is None and "set moving_frame or camera_pose" in bench.warnings[-1]
    bench = Bench().mount().drive()
    assert bench.at(0.5, "") is None and "the images have no frame_id" in bench.warnings[-1]
    assert bench.poses.missing == {NO_FRAME: 1}


@pytest.mark.parametrize("offset", [-120.0, 120.0])
def test_another_clock(offset: float) -> None:
    bench = Bench(camera_pose=BY_PARAMETER)
    for seconds in TIMES + 200:
        bench.poses.take(odometry(base_pose(seconds), seconds + offset))
        assert bench.at(seconds) is None
    assert bench.poses.missing[OTHER_CLOCK] == len(TIMES)
    assert "another clock? the newest pose is 120 s" in bench.warnings[0]


def test_a_loop_goes_on_from_its_start() -> None:
    bench = Bench(camera_pose=BY_PARAMETER).drive().drive()
    bench.check(0.5)
    assert bench.poses.unused == {WENT_BACK: 1}
    assert "/odom: the odometry stamps went back by 1.95 s" in bench.warnings[0]


def test_an_origin_that_restarts_is_a_jump() -> None:
    bench = Bench(camera_pose=BY_PARAMETER, odometry_max_speed=3.0).drive()
    restart = inverse(base_pose(2.0))
    for seconds in np.arange(2.0, 3.0, 0.05):
        bench.poses.take(odometry(restart @ base_pose(seconds), seconds))
    assert bench.poses.unused == {JUMP: 1}
    assert "jumped by" in bench.warnings[0] and "at most 3 m/s" in bench.warnings[0]
    bench.check(1.9)
    found = bench.at(2.5)
    assert found is not None
    np.testing.assert_allclose(found, restart @ camera_pose(2.5), atol=1e-4)


def test_poses_of_other_frames_are_refused_while_the_former_come() -> None:
    bench = Bench().mount()
    for seconds in TIMES:
        bench.poses.take(odometry(base_pose(seconds), seconds))
        bench.poses.take(odometry(np.eye(4), seconds + 0.001, "map", "base_link"))
    bench.check(1.0)
    assert bench.poses.unused == {OTHER_FRAME: len(TIMES)}
    assert "base_link in map is not used, the others are of base_link in odom" in bench.warnings[0]


def test_a_new_odometry_takes_the_place_of_one_that_fell_silent() -> None:
    bench = Bench().mount().drive()
    later = np.arange(4, 5, 0.05)
    bench.drive(lambda pose, seconds: odometry(pose, seconds, "map"), later)
    bench.check(4.5)
    assert "goes on as base_link in map, it was base_link in odom" in bench.warnings[0]


def test_what_is_no_pose_is_counted_and_said() -> None:
    bench = Bench(camera_pose=BY_PARAMETER).drive()
    bad = odometry(base_pose(1.0), 1.02)
    bad.pose.pose.position.y = float("nan")
    bench.poses.take(bad)
    assert bench.poses.unused == {UNREADABLE: 1}
    assert bench.warnings == ["/odom: message not used: the pose has values that are not finite"]
    bench.check(1.02)


def test_a_standstill_is_counted_and_no_problem() -> None:
    bench = Bench(camera_pose=BY_PARAMETER)
    for seconds in TIMES:
        bench.poses.take(odometry(base_pose(min(seconds, 1.0)), seconds))
    found = [bench.at(seconds) for seconds in np.arange(0.05, 1.9, 0.1)]
    assert all(pose is not None for pose in found)
    assert bench.poses.still == 8
    assert bench.poses.report()["standing still"] == "8"
    assert bench.poses.report()["speed"] == "0 m/s, 0 rad/s"


def test_what_is_missing_is_told_with_its_first_case() -> None:
    bench = Bench(camera_pose=BY_PARAMETER).drive()
    for seconds in (2.2, 2.3, 1.0):
        bench.at(seconds)
    (line,) = bench.poses.lines().items()
    assert line[0].startswith(f"/odom: images without a pose: {LATE} (no pose of the camera: the")
    assert line[1] == 2


def test_wrong_options_are_named() -> None:
    with pytest.raises(ValueError, match="camera_pose is 'x', expected seven numbers"):
        Bench(camera_pose="x")
    with pytest.raises(ValueError, match="expected moving_frame to say"):
        Bench(camera_pose=BY_PARAMETER, odometry_type="TF")


def test_a_wait_ends_when_the_pose_comes_and_is_not_repeated_in_vain() -> None:
    bench = Bench(camera_pose=BY_PARAMETER).drive()
    stamp = round(2.5 * SECOND)

    def later() -> None:
        time.sleep(0.05)
        bench.drive(times=np.arange(2.0, 2.6, 0.05))

    thread = threading.Thread(target=later)
    thread.start()
    assert bench.poses.wait(stamp, CAMERA, time.monotonic() + 60)
    thread.join()
    start = time.monotonic()
    assert not bench.poses.wait(3 * SECOND, CAMERA, time.monotonic() + 0.2)
    assert time.monotonic() - start >= 0.2
    start = time.monotonic()
    assert not bench.poses.wait(3 * SECOND, CAMERA, time.monotonic() + 60)
    assert time.monotonic() - start < 30


def test_a_camera_that_turns_on_the_robot() -> None:
    """A pan unit on /tf: the camera's place is that of the image's moment."""
    bench = Bench().drive()
    for seconds in TIMES:
        pan = base_pose(seconds, radius=0.0, rate=0.8)
        bench.tf.take(tf_message(transform(pan, seconds, "base_link", "pan")), static=False)
    bench.tf.take(tf_message(transform(MOUNT, 0, "pan", CAMERA)), static=True)
    found = bench.at(1.02)
    assert found is not None
    expected = base_pose(1.02) @ base_pose(1.02, 0.0, 0.8) @ MOUNT
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_tf_reports_nothing_of_a_topic() -> None:
    bench = Bench(odometry_type="TF").mount()
    away = rigid(np.eye(3), np.array([0, 9.0, 0]))
    for seconds, pose in ((0.0, np.eye(4)), (0.1, away), (0.2, away)):
        bench.tf.take(tf_message(transform(pose, seconds, "odom", "base_link")), static=False)
    bench.at(0.15)
    assert bench.poses.unused == {JUMP: 1}
