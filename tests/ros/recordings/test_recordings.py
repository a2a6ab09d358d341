"""Recordings in: every storage, topic choice, ground truth by stamp, damage."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from dyfn_ros.recordings.open import RecordedFrame, RecordingError, image_topics, open_recording
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.topics import Topics
from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    TYPES,
    camera_info,
    compressed_message,
    image_message,
)
from dyfn_ros.recordings.writer import RecordingWriter

CAMERA = np.array([[40.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]])
SIZE = (24, 32)


def picture(index: int) -> np.ndarray:
    image = np.full((*SIZE, 3), 60, np.uint8)
    image[:, index % 32] = [200, 10 * (index % 20), 30]
    return image


def truth(index: int) -> np.ndarray:
    depth = np.linspace(1, 4, SIZE[0] * SIZE[1]).reshape(SIZE) + index / 10
    depth[0, 0] = np.nan
    return depth


def rgbd(count: int = 5) -> Iterator[FrameToRecord]:
    for index in range(count):
        yield FrameToRecord(picture(index), truth(index), CAMERA, np.eye(4), 100 + index / 10)


def read(path: Path, **options: object) -> list[RecordedFrame]:
    return list(open_recording(path, **options).frames())  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["mcap", "sqlite3", "bare.mcap", "bare.db3"])
@pytest.mark.parametrize("raw", [True, False], ids=["raw", "compressed"])
def test_every_storage_gives_the_frames_back(tmp_path: Path, name: str, raw: bool) -> None:
    write_rgbd_recording(
        tmp_path / name,
        rgbd(),
        storage=None if "." in name else name,
        jpeg_quality=None if raw else 95,
        depth_encoding="32FC1" if raw else "png",
    )
    recording = open_recording(tmp_path / name)
    assert recording.expected_frames == 5
    frames = list(recording.frames())
    assert [f.index for f in frames] == [0, 1, 2, 3, 4]
    assert [f.stamp_ns for f in frames] == [100_000_000_000 + i * 100_000_000 for i in range(5)]
    assert not recording.notes.losses and not recording.notes.warnings
    for frame in frames:
        assert frame.frame_id == "camera_optical"
        assert frame.camera_matrix is not None and frame.depth is not None
        np.testing.assert_array_equal(frame.camera_matrix, CAMERA)
        error = np.abs(frame.image.astype(int) - picture(frame.index))
        assert error.max() == 0 if raw else error.mean() < 6
        np.testing.assert_allclose(frame.depth, truth(frame.index), atol=5e-4)
        assert np.isnan(frame.depth[0, 0])


def test_an_rgbd_folder_is_a_recording(tmp_path: Path) -> None:
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    for index in (0, 9, 10):
        cv2.imwrite(str(tmp_path / f"rgb/{index}.png"), picture(index)[..., ::-1])
        if index != 9:
            cv2.imwrite(str(tmp_path / f"depth/{index}.png"), np.full(SIZE, 1000 + index, "u2"))
    np.savetxt(tmp_path / "K.txt", CAMERA)
    frames = read(tmp_path)
    assert [f.stamp_ns for f in frames] == [0, 100_000_000, 200_000_000]
    np.testing.assert_array_equal(frames[1].image, picture(9))
    assert frames[0].depth is not None and frames[2].depth is not None
    assert frames[1].depth is None
    assert frames[2].depth.max() == np.float32(1.01)
    assert frames[2].info is not None
    np.testing.assert_array_equal(frames[2].info.message().k.reshape(3, 3), CAMERA)
    np.testing.assert_array_equal(frames[2].source.message().data, picture(10).reshape(-1))


def test_log_time_orders_frames_and_ties_keep_the_order_of_recording(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for stamp, shade in [(30, 3), (10, 1), (20, 20), (20, 21), (20, 22)]:
            image = np.full((*SIZE, 3), shade, np.uint8)
            writer.write_image("/image", image, stamp, "camera")
    assert [int(f.image[0, 0, 0]) for f in read(tmp_path / "bag")] == [1, 20, 21, 22, 3]


def test_depth_is_matched_by_header_stamp_not_by_arrival(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for index in range(6):
            image = image_message(picture(index), "rgb8", index * 100, "camera")
            writer.write("/image", IMAGE, image, index * 100)
        for index in (1, 0, 2, 5):  # late, out of order, 3 and 4 missing
            metres = np.full(SIZE, index + 1, np.float32)
            depth = image_message(metres, "32FC1", index * 100 + 3, "camera")
            writer.write("/depth", IMAGE, depth, 1000 + index)
    recording = open_recording(tmp_path / "bag", tolerance=10e-9)
    found = [None if f.depth is None else f.depth[0, 0] for f in recording.frames()]
    assert found == [1, 2, 3, None, None, 6]
    assert recording.notes.warnings == {"/depth: no depth at an image's stamp": 2}


def test_depth_that_comes_first_is_kept_for_its_image(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for index in range(6):
            writer.write_depth("/depth", np.full(SIZE, index + 1.0), index * 100, "camera")
            image = image_message(picture(index), "rgb8", index * 100, "camera")
            writer.write("/image", IMAGE, image, index * 100 + 250)
    found = [f.depth[0, 0] for f in read(tmp_path / "bag") if f.depth is not None]
    assert found == [1, 2, 3, 4, 5, 6]


def test_a_looped_recording_matches_each_loop_to_itself(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for loop in range(2):
            for index in range(4):
                log = (loop * 4 + index) * 100_000_000
                stamp = index * 100_000_000
                image = image_message(picture(index), "rgb8", stamp, "camera")
                metres = np.full(SIZE, 10 * loop + index + 1, np.float32)
                writer.write("/image", IMAGE, image, log)
                depth = image_message(metres, "32FC1", stamp, "camera")
                writer.write("/depth", IMAGE, depth, log + 1000)
    found = [f.depth[0, 0] for f in read(tmp_path / "bag") if f.depth is not None]
    assert found == [1, 2, 3, 4, 11, 12, 13, 14]


def ambiguous(path: Path) -> None:
    with RecordingWriter(path) as writer:
        for side in ("left", "right"):
            writer.write_image(f"/{side}/image", picture(0), 1, side)
            writer.write_jpeg(f"/{side}/image/compressed", picture(0), 1, side)
            writer.write_camera_info(f"/{side}/camera_info", CAMERA, SIZE, 1, side)
            writer.write_depth(f"/{side}/depth", truth(0), 1, side, "16UC1")
        writer.write_jpeg("/left/depth/colored/compressed", picture(0), 1, "left")


def test_several_cameras_are_listed_and_one_can_be_chosen(tmp_path: Path) -> None:
    ambiguous(tmp_path / "bag")
    with pytest.raises(RecordingError) as error:
        open_recording(tmp_path / "bag")
    said = str(error.value)
    assert "--image-topic (image_topic in training data)" in said
    assert "/left/image (sensor_msgs/msg/Image), /right/image (sensor_msgs/msg/Image)" in said
    assert "colored" not in said
    chosen = open_recording(tmp_path / "bag", "/right/image").topics  # the rest is beside it
    assert chosen == Topics("/right/image", "/right/camera_info", "/right/depth")
    assert image_topics(tmp_path / "bag") == ["/left/image", "/right/image"]
    frame = read(tmp_path / "bag", image_topic="/left/image/compressed", depth_topic="none")[0]
    assert frame.depth is None and frame.frame_id == "left"
    assert frame.source.kind == COMPRESSED_IMAGE


def test_depths_of_no_camera_in_particular_are_listed(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        writer.write_image("/camera/color/image", picture(0), 1, "camera")
        for name in ("depth", "front_depth"):
            writer.write_depth(f"/camera/{name}/image", truth(0), 1, "camera", "16UC1")
    with pytest.raises(RecordingError, match=r"--depth-topic .*: /camera/depth.*, /camera/front"):
        open_recording(tmp_path / "bag")


def test_a_wrong_topic_is_named_with_what_there_is(tmp_path: Path) -> None:
    write_rgbd_recording(tmp_path / "bag", rgbd(1))
    with pytest.raises(RecordingError, match=r"no topic /cam, expected one of .*camera_info"):
        open_recording(tmp_path / "bag", "/cam")
    with pytest.raises(RecordingError, match=r"/tf is tf2_msgs/msg/TFMessage, expected sensor"):
        open_recording(tmp_path / "bag", "/tf")
    assert open_recording(tmp_path / "bag", "/camera/image").topics.image.endswith("compressed")


def test_a_recording_without_images_says_what_it_holds(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        writer.write_camera_info("/camera_info", CAMERA, SIZE, 1, "camera")
    with pytest.raises(RecordingError, match=r"no colour image topic; it holds /camera_info"):
        open_recording(tmp_path / "bag")


def test_unusable_calibration_is_a_warning_and_the_frame_stays(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for index, size in enumerate([SIZE, SIZE, (48, 64)]):
            matrix = CAMERA * (0 if index == 1 else 1)
            info = camera_info(matrix, size, index * 10, "camera")
            writer.write("/camera_info", CAMERA_INFO, info, index * 10)
            writer.write_image("/image", picture(index), index * 10 + 1, "camera")
    recording = open_recording(tmp_path / "bag")
    assert [f.camera_matrix is None for f in recording.frames()] == [False, True, True]
    assert any("uncalibrated" in warning for warning in recording.notes.warnings)
    assert any("64 x 48" in warning for warning in recording.notes.warnings)


def test_an_undecodable_image_is_skipped_and_counted(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for index in range(4):
            writer.write_jpeg("/image/compressed", picture(index), index * 10, "camera")
        broken = compressed_message(np.zeros(9, np.uint8), "jpeg", 15, "camera")
        writer.write("/image/compressed", COMPRESSED_IMAGE, broken, 15)
        writer.write_cdr("/image/compressed", COMPRESSED_IMAGE, b"\0\1\0\0abc", 16)
    recording = open_recording(tmp_path / "bag")
    assert [f.index for f in recording.frames()] == [0, 1, 2, 3]
    assert sum(recording.notes.losses.values()) == 2
    assert all("/image/compressed" in loss for loss in recording.notes.losses)


@pytest.mark.parametrize("folder", [True, False], ids=["folder", "bare"])
def test_a_truncated_mcap_is_read_up_to_the_damage(tmp_path: Path, folder: bool) -> None:
    path = tmp_path / ("bag" if folder else "bag.mcap")
    rng = np.random.default_rng(0)
    with RecordingWriter(path) as writer:
        for index in range(60):
            image = rng.integers(0, 255, (*SIZE, 40, 3), np.uint8).reshape(SIZE[0], -1, 3)
            writer.write_image("/image", image, index, "camera")
    file = path / "bag.mcap" if folder else path
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    recording = open_recording(path)
    frames = list(recording.frames())
    assert [f.stamp_ns for f in frames] == list(range(len(frames)))
    assert 20 <= len(frames) < 45
    (loss,) = recording.notes.losses
    assert str(file) in loss and "read up to byte" in loss


def write_with_mcap(path: Path, count: int, profile: str = "") -> None:
    """A recording by another writer: the mcap library, which adds checksums."""
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=4 * picture(0).nbytes)
        writer.start(profile)
        definition, _ = TYPES.generate_msgdef(IMAGE, ros_version=2)
        schema = writer.register_schema(IMAGE, "ros2msg", definition.encode())
        channel = writer.register_channel("/image", "cdr", schema)
        for index in range(count):
            image = image_message(picture(index), "rgb8", index, "camera")
            data = bytes(TYPES.serialize_cdr(image, IMAGE))
            writer.add_message(channel, index, data, index)
        writer.finish()


def test_a_corrupt_chunk_ends_the_reading_and_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    write_with_mcap(path, 60, "ros2")
    data = bytearray(path.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 400] = bytes(400)
    path.write_bytes(data)
    recording = open_recording(path)
    count = len(list(recording.frames()))
    assert 0 < count < 60
    assert any("bag.mcap" in loss for loss in recording.notes.losses)


def test_a_truncated_sqlite_is_read_up_to_the_damage(tmp_path: Path) -> None:
    path = tmp_path / "bag.db3"
    with RecordingWriter(path) as writer:
        for index in range(200):
            writer.write_image("/image", picture(index), index, "camera")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    recording = open_recording(path)
    count = len(list(recording.frames()))
    assert 0 < count < 200
    assert any("bag.db3" in loss for loss in recording.notes.losses)


def test_a_folder_without_metadata_is_read_file_by_file(tmp_path: Path) -> None:
    write_rgbd_recording(tmp_path / "bag", rgbd())
    (tmp_path / "bag" / "metadata.yaml").unlink()
    assert len(read(tmp_path / "bag")) == 5


def test_an_mcap_by_another_writer_without_ros_profile_is_read(tmp_path: Path) -> None:
    write_with_mcap(tmp_path / "other.mcap", 3)
    recording = open_recording(tmp_path / "other.mcap")
    assert len(list(recording.frames())) == 3
    assert not recording.notes.losses


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.mcap", b"", "is empty"),
        ("empty.db3", b"", "is empty"),
        ("text.mcap", b"no recording at all", "is not a readable recording"),
        ("text.db3", b"no recording at all", "is not a readable recording"),
        ("notes.txt", b"hello", "expected a rosbag2 folder, an .mcap, .db3 or .bag file"),
    ],
)
def test_what_is_no_recording_is_refused(
    tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=message) as error:
        open_recording(tmp_path / name)
    assert name in str(error.value)


def test_missing_and_empty_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="does not exist"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(RecordingError, match=r"expected a rosbag2 folder \(metadata.yaml"):
        open_recording(tmp_path)
    (tmp_path / "metadata.yaml").write_text("hello: [")
    with pytest.raises(RecordingError, match=r"expected a rosbag2 folder .*YAML"):
        open_recording(tmp_path)
    (tmp_path / "rgb").mkdir()
    (tmp_path / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match="expected colour images"):
        read(tmp_path)


@pytest.mark.parametrize("packed", [False, True], ids=["raw", "png"])
def test_twelve_bits_in_sixteen_are_said_and_can_be_told(tmp_path: Path, packed: bool) -> None:
    eight = picture(0)[..., 0]
    twelve = np.rint(eight * (4095 / 255)).astype(np.uint16)
    with RecordingWriter(tmp_path / "bag") as writer:
        if packed:
            png = cv2.imencode(".png", twelve)[1].reshape(-1)
            message = compressed_message(png, "mono16; png compressed ", 10**9, "camera")
            writer.write("/image/compressed", COMPRESSED_IMAGE, message, 10**9)
        else:
            writer.write("/image", IMAGE, image_message(twelve, "mono16", 10**9, "camera"), 10**9)
    name = "/image/compressed" if packed else None  # 16-bit PNGs are taken for depth else
    dark = open_recording(tmp_path / "bag", name)
    (frame,) = dark.frames()
    assert frame.image.max() <= 15
    ((text, count),) = dark.notes.warnings.items()
    assert count == 1 and "are below 4096 of 65536" in text and text.endswith("--image-bits 12")
    told = open_recording(tmp_path / "bag", name, image_bits=12)
    (frame,) = told.frames()
    np.testing.assert_array_equal(frame.image[..., 0], eight)
    assert not told.notes.warnings


def test_stray_bytes_in_a_jpeg_are_a_warning(tmp_path: Path) -> None:
    jpeg = cv2.imencode(".jpg", picture(0))[1].tobytes()
    data = np.frombuffer(jpeg[:-2] + b"abc" + jpeg[-2:], np.uint8)
    with RecordingWriter(tmp_path / "bag") as writer:
        message = compressed_message(data, "jpeg", 10**9, "camera")
        writer.write("/image/compressed", COMPRESSED_IMAGE, message, 10**9)
    recording = open_recording(tmp_path / "bag")
    assert len(list(recording.frames())) == 1 and not recording.notes.losses
    (text,) = recording.notes.warnings
    assert "damaged, but whole: Corrupt JPEG data: " in text
