"""A recording's odometry, read as a robot would have met it: values, waiting, bad input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyfn_ros.messages.odometry_options import OdometryOptions
from dyfn_ros.recordings.poses import PoseError, PoseTopic, open_poses
from dyfn_ros.recordings.typestore import TF
from dyfn_ros.recordings.writer import RecordingWriter
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
    tf_message,
    transform,
)

ODOMETRY, POSE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"


def record(
    path: Path,
    make: Callable[[float], Any] = lambda time: odometry(base_pose(time), time),
    kind: str = ODOMETRY,
    topic: str = "/odom",
    tied: bool = True,
    late: float = 0.0,
    times: Any = TIMES,
) -> Path:
    """late: seconds from a message's stamp to its recording."""
    with RecordingWriter(path, overwrite=True) as writer:
        if tied:
            mount = tf_message(transform(MOUNT, 0, "base_link", CAMERA))
            writer.write("/tf_static", TF, mount, 0)
        for time in times:
            writer.write(topic, kind, make(time), round((time + late) * SECOND))
    return path


def at(topic: PoseTopic, seconds: float, recorded: float | None = None) -> np.ndarray | None:
    log = seconds if recorded is None else recorded
    found = topic.at(round(seconds * SECOND), CAMERA, round(log * SECOND))
    return None if found is None else found.pose


def check(topic: PoseTopic, seconds: float) -> None:
    found = at(topic, seconds)
    assert found is not None, topic.poses.lines()
    np.testing.assert_allclose(found, camera_pose(seconds), atol=1e-4)


def test_a_frame_lies_between_the_poses_before_and_after_it(tmp_path: Path) -> None:
    topic = PoseTopic(record(tmp_path / "walk"), OdometryOptions())
    for seconds in (0.0, 0.51, 0.52, 1.777):
        check(topic, seconds)
    assert topic.poses.lines() == {} and not topic.losses


def test_a_pose_that_is_recorded_late_is_waited_for(tmp_path: Path) -> None:
    path = record(tmp_path / "walk", late=0.15)
    check(PoseTopic(path, OdometryOptions(odometry_wait=0.25)), 1.01)
    hasty = PoseTopic(path, OdometryOptions(odometry_wait=0.05))
    assert at(hasty, 1.01) is None
    (line,) = hasty.poses.lines()
    assert "not there yet" in line and "s older than the image" in line


def test_both_ways_of_reading_agree(tmp_path: Path) -> None:
    path = record(tmp_path / "walk")
    topic, lookup = PoseTopic(path, OdometryOptions()), open_poses(path, CAMERA)
    for index, seconds in enumerate(np.arange(0.03, 1.9, 0.11)):
        np.testing.assert_array_equal(at(topic, seconds), lookup(index, round(seconds * SECOND)))


def test_the_camera_s_place_by_parameter_needs_no_tf(tmp_path: Path) -> None:
    path = record(tmp_path / "walk", tied=False)
    check(PoseTopic(path, OdometryOptions(camera_pose=pose_text(MOUNT))), 1.01)
    untied = PoseTopic(path, OdometryOptions())
    assert at(untied, 1.01) is None
    (line,) = untied.poses.lines()
    assert "'base_link'" in line and "'camera_optical'" in line and "set camera_pose" in line


def test_the_topic_is_found_by_its_type(tmp_path: Path) -> None:
    path = record(
        tmp_path / "pose", lambda time: pose_stamped(camera_pose(time), time), POSE, "/camera/pose"
    )
    topic = PoseTopic(path, OdometryOptions())
    check(topic, 0.5)
    assert topic.poses.topic == "/camera/pose"


def test_tf_alone_moves_the_camera(tmp_path: Path) -> None:
    path = record(
        tmp_path / "tf",
        lambda time: tf_message(transform(base_pose(time), time, "odom", "base_link")),
        TF,
        "/tf",
    )
    check(PoseTopic(path, OdometryOptions()), 0.777)
    check(PoseTopic(path, OdometryOptions(), "/tf"), 0.777)
    elsewhere = PoseTopic(path, OdometryOptions(odom_frame="world"))
    assert at(elsewhere, 0.5) is None
    (line,) = elsewhere.poses.lines()
    assert "no frame 'world'" in line and "odom_frame is 'world'" in line


def test_several_and_missing_topics_are_named(tmp_path: Path) -> None:
    path = tmp_path / "two"
    with RecordingWriter(path) as writer:
        for topic in ("/wheel", "/visual"):
            writer.write(topic, ODOMETRY, odometry(np.eye(4), 0.0), 0)
    text = r"choose one with --odometry-topic: /visual \(nav_msgs/msg/Odometry\), /wheel"
    with pytest.raises(PoseError, match=text):
        PoseTopic(path, OdometryOptions())
    assert PoseTopic(path, OdometryOptions(), "/wheel").poses.topic == "/wheel"
    with pytest.raises(PoseError, match="no topic /odom of poses, odometry or TF: /visual"):
        PoseTopic(path, OdometryOptions(), "/odom")
    with RecordingWriter(tmp_path / "none") as writer:
        writer.write_image("/image", np.zeros((8, 8, 3), np.uint8), 0, CAMERA)
    with pytest.raises(PoseError, match="expected a topic of poses, odometry or TF: it has none"):
        PoseTopic(tmp_path / "none", OdometryOptions())


def test_the_times_of_recording_may_stand_for_the_stamps(tmp_path: Path) -> None:
    """A driver whose headers hold no stamps."""
    path = record(tmp_path / "walk", lambda time: odometry(base_pose(time), 0.0))
    check(PoseTopic(path, OdometryOptions(), stamps="log"), 1.01)
    assert at(PoseTopic(path, OdometryOptions()), 1.01) is None


def test_a_recording_that_loops_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "loop"
    with RecordingWriter(path) as writer:
        for turn in range(2):
            for time in TIMES:
                message = odometry(base_pose(time), time)
                writer.write("/odom", ODOMETRY, message, round((time + 2 * turn) * SECOND))
    topic = PoseTopic(path, OdometryOptions(camera_pose=pose_text(MOUNT)))
    for turn in range(2):
        for seconds in (0.5, 1.5):
            found = at(topic, seconds, seconds + 2 * turn)
            np.testing.assert_allclose(found, camera_pose(seconds), atol=1e-4)  # type: ignore[arg-type]
    assert topic.poses.unused == {"time went back": 1}


def test_another_clock_costs_the_poses_and_is_said(tmp_path: Path) -> None:
    path = record(tmp_path / "walk", lambda time: odometry(base_pose(time), time + 500))
    topic = PoseTopic(path, OdometryOptions())
    assert [at(topic, seconds) for seconds in (0.5, 1.0, 1.5)] == [None] * 3
    (line,) = topic.poses.lines().items()
    assert "another clock" in line[0] and "50" in line[0] and line[1] == 3


def test_a_damaged_message_is_lost_alone(tmp_path: Path) -> None:
    path = tmp_path / "walk"
    with RecordingWriter(path) as writer:
        for time in TIMES:
            stamp = round(time * SECOND)
            writer.write("/odom", ODOMETRY, odometry(base_pose(time), time), stamp)
            if time == TIMES[20]:
                writer.write_cdr("/odom", ODOMETRY, b"\0\1\0\0short", stamp + 1)
    topic = PoseTopic(path, OdometryOptions(camera_pose=pose_text(MOUNT)))
    check(topic, 1.02)
    (loss,) = topic.losses.items()
    assert "/odom: cannot read as nav_msgs/msg/Odometry" in loss[0] and loss[1] == 1
