"""Which topic is the image, its CameraInfo and its depth, in the layouts of real recorders."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer

from dyfn_ros.recordings.open import RecordingError, image_topics, open_recording
from dyfn_ros.recordings.topics import Topics
from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    TYPES,
    camera_info,
    compressed_message,
    depth_to_millimetres,
    image_message,
)
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.formats_of_bags import COLOUR, TRUTH
from tests.support.formats_of_messages import cut_other_depth
from tests.support.made_recordings import ROS1, ros1_bytes
from tests.support.numbered import CAMERA, SECOND, SIZE, depth, numbers, picture

COUNT = 4
GREY = np.full(SIZE, 7, np.uint8)


def pixels(encoding: str, index: int) -> np.ndarray:
    if encoding in ("16UC1", "mono16"):
        return depth_to_millimetres(depth(index))
    if encoding == "32FC1":
        return depth(index)
    return GREY if encoding == "mono8" else picture(index)


def write(path: Path, topics: dict[str, str]) -> Path:
    """topics: name -> encoding of an Image, or "info"."""
    with RecordingWriter(path) as writer:
        for index in range(COUNT):
            stamp = SECOND + index * SECOND // 10
            for topic, encoding in topics.items():
                if encoding == "info":
                    writer.write_camera_info(topic, CAMERA, SIZE, stamp, "camera")
                else:
                    image = image_message(pixels(encoding, index), encoding, stamp, "camera")
                    writer.write(topic, IMAGE, image, stamp)
    return path


@pytest.mark.parametrize(
    ("image", "truth", "encoding", "others"),
    [
        ("/depth_camera/image_raw", "/depth_camera/depth/image_raw", "16UC1", {}),
        ("/depth_cam/rgb/image_raw", "/depth_cam/depth/image_raw", "16UC1", {}),
        ("/cam/Color/image", "/cam/Depth/image", "mono16", {}),
        ("/depth/rgb/image_raw", "/depth/depth/image_raw", "32FC1", {}),
        ("/rgb/image", "/depth/image", "mono16", {"/depth/image_colored": "rgb8"}),
        ("/camera/color/image", "/camera/depth/image", "16UC1", {"/camera/infra1/image": "mono8"}),
        ("/rgb/image", "/depth/image", "16UC1", {"/ir/image": "16UC1"}),
        ("/rgb/image", "/depth/image", "16UC1", {"/thermal_camera/image": "16UC1"}),
        ("/rgb/image", "/depth/image", "32FC1", {"/confidence/confidence_map": "32FC1"}),
        (
            "/camera/color/image_raw",
            "/camera/aligned_depth_to_color/image_raw",
            "16UC1",
            {"/camera/depth/image_rect_raw": "16UC1"},
        ),
        (
            "/camera/rgb/image_color",
            "/camera/depth_registered/image",
            "32FC1",
            {"/camera/depth/image": "32FC1"},
        ),
        ("/cam/infra1/image_rect_raw", "/cam/depth/image_rect_raw", "16UC1", {}),
    ],
)
def test_image_and_depth_are_told_apart(
    tmp_path: Path, image: str, truth: str, encoding: str, others: dict[str, str]
) -> None:
    info = image.rsplit("/", 1)[0] + "/camera_info"
    write(tmp_path / "bag", {**others, info: "info", image: "rgb8", truth: encoding})
    recording = open_recording(tmp_path / "bag")
    topics = recording.topics
    assert (topics.image, topics.camera_info, topics.depth) == (image, info, truth)
    assert numbers(recording.frames()) == [*range(COUNT)]


def test_a_thermal_image_is_no_depth_unless_it_is_named(tmp_path: Path) -> None:
    write(tmp_path / "bag", {"/rgb/image": "rgb8", "/thermal/image": "16UC1"})
    assert open_recording(tmp_path / "bag").topics.depth is None
    named = open_recording(tmp_path / "bag", depth_topic="/thermal/image")
    assert numbers(named.frames()) == [*range(COUNT)]


def test_infrared_is_the_image_where_there_is_no_other(tmp_path: Path) -> None:
    write(tmp_path / "bag", {"/infra1/image": "mono8", "/depth/image": "16UC1"})
    assert open_recording(tmp_path / "bag").topics.image == "/infra1/image"


def test_a_picture_of_depth_alone_is_refused_with_the_way_on(tmp_path: Path) -> None:
    write(tmp_path / "bag", {"/camera/depth/image_colored": "rgb8"})
    with pytest.raises(RecordingError, match=r"no colour image topic.*--image-topic takes one"):
        open_recording(tmp_path / "bag")
    named = open_recording(tmp_path / "bag", "/camera/depth/image_colored")
    assert len(list(named.frames())) == COUNT


@pytest.mark.parametrize("infrared", [False, True])
def test_a_bag_of_the_realsense_viewer_needs_no_options(tmp_path: Path, infrared: bool) -> None:
    """CameraInfo once, below .../info; depth as mono16; frame_ids are numbers."""
    sensors = {"sensor_0/Depth_0": "mono16", "sensor_1/Color_0": "rgb8"}
    if infrared:
        sensors["sensor_0/Infrared_1"] = "mono8"
    with Bag1Writer(tmp_path / "viewer.bag") as writer:
        for sensor in sensors:
            info = camera_info(CAMERA, SIZE, 0, "")
            topic = f"/device_0/{sensor}/info/camera_info"
            connection = writer.add_connection(topic, CAMERA_INFO, typestore=ROS1)
            writer.write(connection, 1, ros1_bytes(info, CAMERA_INFO))
        connections = {
            sensor: writer.add_connection(f"/device_0/{sensor}/image/data", IMAGE, typestore=ROS1)
            for sensor in sensors
        }
        for index in range(COUNT):
            stamp = SECOND + index * SECOND // 30
            for sensor, encoding in sensors.items():
                image = image_message(pixels(encoding, index), encoding, stamp, str(index))
                writer.write(connections[sensor], stamp, ros1_bytes(image, IMAGE))
    recording = open_recording(tmp_path / "viewer.bag")
    assert recording.topics == Topics(
        "/device_0/sensor_1/Color_0/image/data",
        "/device_0/sensor_1/Color_0/info/camera_info",
        "/device_0/sensor_0/Depth_0/image/data",
        "/device_0/sensor_0/Depth_0/info/camera_info",
    )
    frames = list(recording.frames())
    assert numbers(frames) == [*range(COUNT)]
    assert frames[0].camera_matrix is not None and frames[0].camera_matrix[0, 0] == 40
    assert not recording.notes.losses and not recording.notes.warnings


def jpeg(index: int) -> np.ndarray:
    return cv2.imencode(".jpg", picture(index)[..., ::-1])[1].reshape(-1)


def write_twins(path: Path, raw: set[int], compressed: set[int]) -> Path:
    with RecordingWriter(path) as writer:
        for index in range(10):
            stamp = SECOND + index * SECOND // 10
            if index in raw:
                writer.write_image("/camera/image", picture(index), stamp, "camera")
            if index in compressed:
                packed = compressed_message(jpeg(index), "jpeg", stamp, "camera")
                writer.write("/camera/image/compressed", COMPRESSED_IMAGE, packed, stamp)
    return path


@pytest.mark.parametrize(
    ("raw", "compressed", "chosen"),
    [
        ({4}, {*range(10)}, "/camera/image/compressed"),
        ({*range(10)}, {1, 2, 3}, "/camera/image"),
        ({*range(10)}, {*range(10)}, "/camera/image"),
    ],
)
def test_of_twins_the_fuller_is_read(
    tmp_path: Path, raw: set[int], compressed: set[int], chosen: str
) -> None:
    recording = open_recording(write_twins(tmp_path / "bag", raw, compressed))
    assert recording.topics.image == chosen and len(list(recording.frames())) == 10
    assert image_topics(tmp_path / "bag") == [chosen]
    assert not recording.notes.warnings


def test_a_named_twin_with_fewer_messages_is_said(tmp_path: Path) -> None:
    write_twins(tmp_path / "bag", {4}, {*range(10)})
    recording = open_recording(tmp_path / "bag", "/camera/image")
    assert len(list(recording.frames())) == 1
    expected = "/camera/image holds 1 messages, /camera/image/compressed 10"
    assert recording.notes.warnings[expected] == 1


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("empty", ["/camera/image", "/camera/depth/image"])
def test_topics_without_messages_are_named(
    tmp_path: Path, plugin: StoragePlugin, empty: str
) -> None:
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        for topic in ("/camera/image", "/camera/depth/image"):
            connection = writer.add_connection(topic, IMAGE, typestore=TYPES)
            encoding = "16UC1" if "depth" in topic else "rgb8"
            image = image_message(pixels(encoding, 0), encoding, SECOND, "camera")
            if topic != empty:
                writer.write(connection, SECOND, TYPES.serialize_cdr(image, IMAGE))
    said = rf"recorded without messages: {empty} \(sensor_msgs/msg/Image\)"
    if empty == "/camera/image":
        with pytest.raises(RecordingError, match=said):
            open_recording(tmp_path / "bag")
        return
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) == [None]
    assert any(said.replace("\\", "") in text for text in recording.notes.warnings)


@pytest.mark.parametrize(("named", "lost"), [(False, True), (True, False)])
def test_depth_that_cannot_be_read_costs_nothing_of_the_other(
    tmp_path: Path, named: bool, lost: bool
) -> None:
    path = cut_other_depth(tmp_path)
    topics = (COLOUR, None, TRUTH) if named else (None, None, None)
    recording = open_recording(path, *topics)
    assert numbers([*recording.frames()]) == [*range(COUNT)]
    assert recording.topics.depth == TRUTH
    found = [text for text in recording.notes.losses if "/cam/depth/second" in text]
    assert bool(found) == lost
