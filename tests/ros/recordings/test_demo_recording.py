"""bags/demo is what bags/README.md says: a robot's drive, its noisy odometry, its true poses."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from dyfn_core.geometry.projection import back_project
from dyfn_ros.recordings.open import RecordedFrame, open_recording
from dyfn_ros.recordings.poses import PoseLookup, open_poses
from dyfn_ros.recordings.storage.open import open_storage

ROOT = Path(__file__).resolve().parents[3]
DEMO = ROOT / "bags/demo"
CAMERA = "camera_optical_frame"
KINDS = {
    "/camera/image/compressed": "sensor_msgs/msg/CompressedImage",
    "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "/camera/depth/image/compressed": "sensor_msgs/msg/CompressedImage",
    "/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/ground_truth/pose": "geometry_msgs/msg/PoseStamped",
}


@pytest.fixture(scope="module")
def frames() -> list[RecordedFrame]:
    return list(open_recording(DEMO).frames())


def poses(lookup: PoseLookup, frames: list[RecordedFrame]) -> np.ndarray:
    found = [lookup(frame.index, frame.stamp_ns) for frame in frames]
    return np.array([pose for pose in found if pose is not None])


@pytest.fixture(scope="module")
def true(frames: list[RecordedFrame]) -> np.ndarray:
    return poses(open_poses(DEMO, CAMERA, "/ground_truth/pose"), frames)


def test_it_is_small_and_holds_the_topics_that_the_page_names() -> None:
    assert sum(path.stat().st_size for path in DEMO.iterdir()) < 8 * 2**20
    assert {name: t.kind for name, t in open_storage(DEMO).topics.items()} == KINDS
    page = (ROOT / "bags/README.md").read_text()
    assert all(f"`{name}`" in page for name in KINDS)


def test_frames_are_whole_and_the_stamps_are_those_of_a_camera(frames: list[RecordedFrame]) -> None:
    assert len(frames) >= 300
    seconds = np.array([frame.stamp_ns for frame in frames]) / 1e9
    np.testing.assert_allclose(np.diff(seconds), 0.1, atol=1e-4)
    for frame in frames:
        assert frame.image.shape == (240, 320, 3) and frame.info is not None
        assert frame.depth is not None and np.isfinite(frame.depth).mean() > 0.5
        near, far = np.nanquantile(frame.depth, [0.0, 1.0])
        assert near > 0.2 and far <= 10.0


def test_depth_and_true_poses_are_of_one_world(
    frames: list[RecordedFrame], true: np.ndarray
) -> None:
    for index in range(0, len(frames) - 4, 40):
        first, then = frames[index], frames[index + 4]
        assert first.depth is not None and then.depth is not None and first.info is not None
        matrix = np.array(first.info.message().k).reshape(3, 3)
        points = back_project(first.depth, matrix)
        move = np.linalg.inv(true[index + 4]) @ true[index]
        seen = points @ move[:3, :3].T + move[:3, 3]
        seen = seen[seen[:, 2] > 0.2]
        u, v = np.round((seen @ matrix.T)[:, :2].T / seen[:, 2]).astype(int)
        inside = (u >= 0) & (u < 320) & (v >= 0) & (v < 240)
        expected, measured = seen[inside, 2], then.depth[v[inside], u[inside]]
        assert np.nanmedian(np.abs(measured / expected - 1)) < 0.004


def test_it_moves_as_a_wheeled_robot_does(frames: list[RecordedFrame], true: np.ndarray) -> None:
    steps = np.linalg.inv(true[:-1]) @ true[1:]
    speeds = 10 * np.linalg.norm(true[1:, :3, 3] - true[:-1, :3, 3], axis=1)
    turns = 10 * np.degrees(Rotation.from_matrix(steps[:, :3, :3]).magnitude())
    assert speeds.max() < 0.8 and np.median(speeds) > 0.3
    assert 35 < turns.max() < 60
    assert (speeds < 0.02).sum() >= 15  # it stops
    height = true[:, 2, 3]
    assert height.min() > 0.5 and height.max() < 1.2 and np.ptp(height) < 0.01
    nearest = min(np.nanmedian(frame.depth) for frame in frames)
    assert nearest < 0.9  # one look at a near cabinet
    assert np.linalg.norm(true[1:, :3, 3] - true[:-1, :3, 3], axis=1).sum() > 12


def test_odometry_errs_as_the_page_says_and_leads_to_the_camera(
    frames: list[RecordedFrame], true: np.ndarray
) -> None:
    page = (ROOT / "bags/README.md").read_text()
    scale, walk, turn = re.search(
        r"([\d.]+)% scale.*?([\d.]+)% of the\s+distance.*?([\d.]+) degrees", page, re.DOTALL
    ).groups()  # type: ignore[union-attr]
    assert (float(scale), float(walk), float(turn)) == (2.0, 1.0, 0.2)
    by_tf = poses(open_poses(DEMO, CAMERA), frames)
    by_odom = poses(open_poses(DEMO, CAMERA, "/odom"), frames)
    np.testing.assert_allclose(by_tf, by_odom, atol=1e-6)

    def path(of: np.ndarray, every: int = 5) -> float:
        return float(np.linalg.norm(np.diff(of[::every, :3, 3], axis=0), axis=1).sum())

    assert path(by_tf) / path(true) == pytest.approx(1.02, abs=0.005)
    ahead = [np.unwrap(np.arctan2(p[:, 1, 2], p[:, 0, 2])) for p in (by_tf, true)]
    wrong = np.degrees(np.abs((ahead[0] - ahead[0][0]) - (ahead[1] - ahead[1][0])))
    assert 0.2 < wrong.max() < 4 * 0.2 * np.sqrt(path(true)) + 0.5  # the floor rocks the camera
    assert np.ptp(by_tf[:, 2, 3]) < 1e-6  # planar


def test_odometry_comes_at_a_wheeled_robots_rate_with_covariances() -> None:
    messages: list[Any] = [r.message() for r in open_storage(DEMO).messages(["/odom"])]
    stamps = [m.header.stamp.sec + m.header.stamp.nanosec / 1e9 for m in messages]
    assert 20 <= 1 / np.median(np.diff(stamps)) <= 50
    assert {(m.header.frame_id, m.child_frame_id) for m in messages} == {("odom", "base_link")}
    spread = np.array([m.pose.covariance.reshape(6, 6).diagonal() for m in messages])
    assert (np.diff(spread[:, [0, 1, 5]], axis=0) >= 0).all() and (spread > 0).all()
    speed = np.array([m.twist.twist.linear.x for m in messages])
    assert 0.6 < speed.max() < 0.8 and speed.min() > -0.01


def test_late_listeners_get_the_cameras_place() -> None:
    topics = yaml.safe_load((DEMO / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    by_name = {t["topic_metadata"]["name"]: t for t in topics["topics_with_message_count"]}
    assert "transient_local" in str(by_name["/tf_static"]["topic_metadata"]["offered_qos_profiles"])
    assert by_name["/tf_static"]["message_count"] == 1
