"""Recordings out, read back with rosbags and with the mcap library."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.typestore import IMAGE, TYPES, depth_to_millimetres, quaternion_from_matrix
from dyfn_ros.recordings.writer import RecordingWriter

CAMERA = np.array([[100.0, 0, 31.5], [0, 101.0, 23.5], [0, 0, 1]])


def frames(count: int = 3) -> list[FrameToRecord]:
    rng = np.random.default_rng(0)
    made = []
    for index in range(count):
        image = cv2.resize(rng.integers(0, 255, (4, 5, 3), np.uint8), (64, 48))
        depth = np.linspace(0.5, 70, 48 * 64).reshape(48, 64)
        depth[0, :3] = [0, np.nan, np.inf]
        pose = np.eye(4)
        pose[:3, 3] = [index, 2, 3]
        made.append(FrameToRecord(image, depth, CAMERA, pose, 12.5 + index / 10))
    return made


def messages(path: Path) -> dict[str, list]:
    read: dict[str, list] = {}
    with Reader(path) as reader:
        for connection, stamp, data in reader.messages():
            message = TYPES.deserialize_cdr(data, connection.msgtype)
            read.setdefault(connection.topic, []).append((stamp, message))
    return read


@pytest.mark.parametrize("name", ["mcap", "sqlite3", "bare.mcap", "bare.db3"])
def test_every_storage_gives_back_what_was_written(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    storage = None if "." in name else name
    assert write_rgbd_recording(path, frames(), storage=storage) == 3
    assert path.is_dir() == ("." not in name)
    read = messages(path)
    assert {topic: len(found) for topic, found in read.items()} == {
        "/camera/image/compressed": 3,
        "/camera/camera_info": 3,
        "/camera/depth/image/compressed": 3,
        "/camera/pose": 3,
        "/tf": 3,
    }
    stamp, info = read["/camera/camera_info"][1]
    assert stamp == 12_600_000_000
    assert (info.header.stamp.sec, info.header.stamp.nanosec) == (12, 600_000_000)
    assert (info.width, info.height) == (64, 48)
    np.testing.assert_array_equal(info.k.reshape(3, 3), CAMERA)
    picture = cv2.imdecode(read["/camera/image/compressed"][0][1].data, cv2.IMREAD_COLOR)
    assert np.abs(picture[..., ::-1].astype(int) - frames()[0].image).mean() < 4
    depth = cv2.imdecode(read["/camera/depth/image/compressed"][0][1].data, cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(depth, depth_to_millimetres(frames()[0].depth_m))
    pose = read["/camera/pose"][2][1].pose
    assert (pose.position.x, pose.position.y, pose.orientation.w) == (2.0, 2.0, 1.0)


def test_a_folder_has_real_metadata(tmp_path: Path) -> None:
    write_rgbd_recording(tmp_path / "demo", frames())
    info = yaml.safe_load((tmp_path / "demo" / "metadata.yaml").read_text())
    info = info["rosbag2_bagfile_information"]
    assert info["storage_identifier"] == "mcap"
    assert info["message_count"] == 15
    assert info["relative_file_paths"] == ["demo.mcap"]
    assert info["starting_time"]["nanoseconds_since_epoch"] == 12_500_000_000


def test_the_mcap_library_reads_a_bare_file(tmp_path: Path) -> None:
    write_rgbd_recording(tmp_path / "demo.mcap", frames())
    with (tmp_path / "demo.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        found = list(reader.iter_messages(topics=["/camera/camera_info"]))
    assert [message.log_time for _, _, message in found] == [
        12_500_000_000,
        12_600_000_000,
        12_700_000_000,
    ]
    assert found[0][0].encoding == "ros2msg"
    assert found[0][1].message_encoding == "cdr"


def test_raw_topics_hold_the_exact_pixels(tmp_path: Path) -> None:
    path = tmp_path / "raw"
    write_rgbd_recording(path, frames(1), jpeg_quality=None, depth_encoding="32FC1")
    read = messages(path)
    image = read["/camera/image"][0][1]
    assert (image.encoding, image.step) == ("rgb8", 64 * 3)
    np.testing.assert_array_equal(image.data.reshape(48, 64, 3), frames()[0].image)
    depth = read["/camera/depth/image"][0][1]
    values = depth.data.view(np.float32).reshape(48, 64)
    assert depth.encoding == "32FC1"
    assert np.isnan(values[0, :3]).all()
    np.testing.assert_array_equal(values[1:], frames()[0].depth_m[1:].astype(np.float32))


def test_a_failed_recording_leaves_nothing_and_keeps_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "demo"
    write_rgbd_recording(path, frames(2))
    with pytest.raises(RecordingError, match="exists already"):
        write_rgbd_recording(path, frames())
    with pytest.raises(ZeroDivisionError):
        write_rgbd_recording(path, (frames()[0] if i else 1 / 0 for i in (1, 0)), overwrite=True)
    assert len(messages(path)["/tf"]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["demo"]
    write_rgbd_recording(path, frames(1), overwrite=True)
    assert len(messages(path)["/tf"]) == 1


def test_no_frames_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no frames"):
        write_rgbd_recording(tmp_path / "demo", [])
    assert list(tmp_path.iterdir()) == []


def test_wrong_use_is_named(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="'tape' is unknown"):
        RecordingWriter(tmp_path / "demo", "tape")
    with pytest.raises(RecordingError, match=r"a \.db3 file is sqlite3"):
        RecordingWriter(tmp_path / "demo.db3", "mcap")
    with (
        pytest.raises(RecordingError, match="/tf holds tf2_msgs/msg/TFMessage"),
        RecordingWriter(tmp_path / "demo") as writer,
    ):
        writer.write_transform(np.eye(4), 1, "world", "camera")
        writer.write_cdr("/tf", IMAGE, b"", 2)


def test_depth_beyond_sixteen_bits_is_invalid_not_wrapped() -> None:
    depth = np.array([[-1.0, 0.0, 0.0004, 0.001, 65.535, 65.536, 1e9, np.nan, np.inf]])
    assert depth_to_millimetres(depth).tolist() == [[0, 0, 0, 1, 65535, 0, 0, 0, 0]]


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.dot(q, q) > 0.01))
def test_quaternion_is_the_rotation(components: list[float]) -> None:
    x, y, z, w = np.array(components) / np.linalg.norm(components)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = np.array(quaternion_from_matrix(rotation))
    assert abs(abs(found @ [x, y, z, w]) - 1) < 1e-9
    assert found[3] >= 0
