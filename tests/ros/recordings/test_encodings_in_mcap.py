"""Type names of other styles, and MCAP messages that are not CDR."""

import base64
import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin

from dyfn_ros.recordings.open import RecordingError, open_recording
from dyfn_ros.recordings.storage.base import ros_type
from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    IMAGE,
    TYPES,
    camera_info,
    depth_to_millimetres,
    image_message,
)
from tests.support.made_recordings import ros1_bytes, write_rosbag2
from tests.support.numbered import CAMERA, SECOND, SIZE, depth, numbers, picture

COUNT = 4
STYLES = [
    "{0}/msg/{1}",
    "{0}/{1}",
    "{0}::msg::{1}",
    "{0}::msg::dds_::{1}_",
    "{0}.msg.{1}",
    "{0}/msg/dds_/{1}_",
]
Messages = dict[str, tuple[str, str, bytes, Callable[[int], bytes]]]


def stamp(index: int) -> int:
    return SECOND + index * SECOND // 10


def write(path: Path, topics: Messages, *, indexed: bool = True) -> Path:
    """topics: name -> encoding, schema's name and data, maker of the i-th message."""
    with path.open("wb") as file:
        writer = McapWriter(
            file,
            compression=CompressionType.ZSTD,
            chunk_size=4096,
            use_statistics=indexed,
            repeat_channels=indexed,
        )
        writer.start()
        channels = {
            topic: writer.register_channel(
                topic, encoding, writer.register_schema(name, _schema_encoding(encoding), data)
            )
            for topic, (encoding, name, data, _) in topics.items()
        }
        for index in range(COUNT):
            for topic, (*_, maker) in topics.items():
                writer.add_message(channels[topic], stamp(index), maker(index), stamp(index))
        writer.finish()
    return path


def _schema_encoding(encoding: str) -> str:
    return {"cdr": "ros2msg", "ros1": "ros1msg", "json": "jsonschema"}.get(encoding, encoding)


def colour(index: int) -> Any:
    return image_message(picture(index), "rgb8", stamp(index), "camera")


def truth(index: int) -> Any:
    millimetres = depth_to_millimetres(depth(index))
    return image_message(millimetres, "16UC1", stamp(index), "camera")


def info(index: int) -> Any:
    return camera_info(CAMERA, SIZE, stamp(index), "camera")


def ros(style: str, encoding: str = "cdr") -> Messages:
    serialize = TYPES.serialize_cdr if encoding == "cdr" else ros1_bytes
    image, calibration = (
        style.format("sensor_msgs", "Image"),
        style.format("sensor_msgs", "CameraInfo"),
    )
    return {
        "/image": (encoding, image, b"", lambda i: bytes(serialize(colour(i), IMAGE))),
        "/depth": (encoding, image, b"", lambda i: bytes(serialize(truth(i), IMAGE))),
        "/camera_info": (
            encoding,
            calibration,
            b"",
            lambda i: bytes(serialize(info(i), CAMERA_INFO)),
        ),
    }


def check(path: Path, difference: int = 0) -> None:
    recording = open_recording(path)
    frames = list(recording.frames())
    assert numbers(frames) == [*range(COUNT)]
    assert [f.stamp_ns for f in frames] == [stamp(index) for index in range(COUNT)]
    for index, frame in enumerate(frames):
        assert frame.frame_id == "camera" and frame.camera_matrix is not None
        np.testing.assert_array_equal(frame.camera_matrix, CAMERA)
        np.testing.assert_allclose(
            frame.image.astype(int), picture(index).astype(int), atol=difference
        )
    assert not recording.notes.losses and not recording.notes.warnings


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("indexed", [True, False])
def test_type_names_of_every_style_are_read(tmp_path: Path, style: str, indexed: bool) -> None:
    check(write(tmp_path / "walk.mcap", ros(style), indexed=indexed))


@pytest.mark.parametrize("style", STYLES)
def test_type_names_in_a_database_are_read(tmp_path: Path, style: str) -> None:
    write_rosbag2(tmp_path / "bag", range(COUNT), StoragePlugin.SQLITE3)
    with closing(sqlite3.connect(next((tmp_path / "bag").glob("*.db3")))) as database:
        database.execute("UPDATE topics SET type = ?", (style.format("sensor_msgs", "Image"),))
        database.commit()
    assert len(list(open_recording(tmp_path / "bag").frames())) == COUNT


@pytest.mark.parametrize("name", ["Image", "a/srv/B", "a/action/B", "a/b/c/D", ""])
def test_what_is_no_message_type_stays(name: str) -> None:
    assert ros_type(name) == name


@pytest.mark.parametrize("style", ["{0}/{1}", "{0}/msg/{1}"])
@pytest.mark.parametrize("indexed", [True, False])
def test_ros_1_messages_in_mcap_are_read(tmp_path: Path, style: str, indexed: bool) -> None:
    check(write(tmp_path / "walk.mcap", ros(style, "ros1"), indexed=indexed))


def png(index: int) -> bytes:
    return bytes(cv2.imencode(".png", picture(index)[..., ::-1])[1])


def fields(kind: str, index: int) -> dict[str, Any]:
    """A message of Foxglove's, its time left out."""
    size = {"width": SIZE[1], "height": SIZE[0]}
    if kind == "CompressedImage":
        return {"frame_id": "camera", "format": "png", "data": png(index)}
    if kind == "CameraCalibration":
        arrays = {name: [float(v) for v in getattr(info(index), name.lower())] for name in "DKRP"}
        return {"frame_id": "camera", **size, "distortion_model": "plumb_bob", **arrays}
    image = truth(index)
    extra = {"encoding": "16UC1", "step": int(image.step), "data": image.data.tobytes()}
    return {"frame_id": "camera", **size, **extra}


def as_json(kind: str, index: int) -> bytes:
    content = fields(kind, index)
    if "data" in content:
        content["data"] = base64.b64encode(content["data"]).decode()
    sec, nsec = divmod(stamp(index), SECOND)
    return json.dumps({"timestamp": {"sec": sec, "nsec": nsec}, **content}).encode()


def foxglove(encoding: str, schema: Callable[[str], bytes], maker: Any) -> Messages:
    kinds = {"/image": "CompressedImage", "/depth": "RawImage", "/camera_info": "CameraCalibration"}
    return {
        topic: (encoding, f"foxglove.{kind}", schema(kind), lambda i, kind=kind: maker(kind, i))
        for topic, kind in kinds.items()
    }


@pytest.mark.parametrize("indexed", [True, False])
def test_foxglove_json_is_read(tmp_path: Path, indexed: bool) -> None:
    messages = foxglove("json", lambda kind: b"{}", as_json)
    check(write(tmp_path / "walk.mcap", messages, indexed=indexed))


def test_foxglove_protobuf_is_read(tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf")
    made = {kind: protobuf_class(kind) for kind in PROTOBUF}

    def maker(kind: str, index: int) -> bytes:
        message = made[kind][0](**fields(kind, index))
        message.timestamp.seconds, message.timestamp.nanos = divmod(stamp(index), SECOND)
        return bytes(message.SerializeToString())

    check(write(tmp_path / "walk.mcap", foxglove("protobuf", lambda kind: made[kind][1], maker)))


# Foxglove's messages: field numbers, types of google.protobuf.FieldDescriptorProto.
DOUBLE, STRING, BYTES, FIXED32 = 1, 9, 12, 7
PROTOBUF = {
    "CompressedImage": {"data": (2, BYTES), "format": (3, STRING), "frame_id": (4, STRING)},
    "RawImage": {
        "frame_id": (7, STRING),
        "width": (2, FIXED32),
        "height": (3, FIXED32),
        "encoding": (4, STRING),
        "step": (5, FIXED32),
        "data": (6, BYTES),
    },
    "CameraCalibration": {
        "frame_id": (9, STRING),
        "width": (2, FIXED32),
        "height": (3, FIXED32),
        "distortion_model": (4, STRING),
        "D": (5, DOUBLE),
        "K": (6, DOUBLE),
        "R": (7, DOUBLE),
        "P": (8, DOUBLE),
    },
}


def protobuf_class(kind: str) -> tuple[Any, bytes]:
    """The class of a message, and the schema that MCAP keeps of it."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2

    file = descriptor_pb2.FileDescriptorProto(
        name=f"foxglove/{kind}.proto",
        package="foxglove",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    )
    message = file.message_type.add(name=kind)
    message.field.add(
        name="timestamp", number=1, type=11, label=1, type_name=".google.protobuf.Timestamp"
    )
    for name, (number, kind_of_field) in PROTOBUF[kind].items():
        label = 3 if len(name) == 1 else 1
        message.field.add(name=name, number=number, type=kind_of_field, label=label)
    stamps = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamps)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(stamps)
    pool.Add(file)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{kind}"))
    schema = descriptor_pb2.FileDescriptorSet(file=[stamps, file])
    return made, schema.SerializeToString()


@pytest.mark.parametrize(
    ("encoding", "name", "said"),
    [
        ("protobuf", "foxglove.CompressedImage", r"whose schema cannot be used"),
        ("protobuf", "foxglove.CompressedVideo", r"whose schema cannot be used"),
        ("protobuf", "foxglove.SceneUpdate", r"encoded as protobuf, which is not read"),
        ("json", "sensor_msgs/Image", r"encoded as json, which is not read"),
        ("flatbuffer", "foxglove.RawImage", r"encoded as flatbuffer, which is not read"),
    ],
)
@pytest.mark.parametrize("indexed", [True, False])
def test_other_encodings_are_named(
    tmp_path: Path, encoding: str, name: str, said: str, indexed: bool
) -> None:
    if encoding == "protobuf":
        pytest.importorskip("mcap_protobuf")
    topics: Messages = {"/cam": (encoding, name, b"", lambda i: b"{}")}
    write(tmp_path / "walk.mcap", topics, indexed=indexed)
    with pytest.raises(RecordingError, match=rf"it holds /cam \({name}, .*{said}"):
        open_recording(tmp_path / "walk.mcap")


def test_protobuf_without_its_library_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "mcap_protobuf.decoder", None)
    topics: Messages = {"/cam": ("protobuf", "foxglove.RawImage", b"", lambda i: b"")}
    write(tmp_path / "walk.mcap", topics)
    with pytest.raises(RecordingError, match=r"which needs `pip install 'dyfn_ros\[foxglove\]'`"):
        open_recording(tmp_path / "walk.mcap")


def test_a_message_that_is_not_its_encoding_is_a_loss(tmp_path: Path) -> None:
    messages = foxglove("json", lambda kind: b"{}", as_json)
    encoding, name, data, maker = messages["/image"]
    broken: Messages = {
        **messages,
        "/image": (encoding, name, data, lambda i: b"{" if i == 2 else maker(i)),
    }
    recording = open_recording(write(tmp_path / "walk.mcap", broken))
    assert numbers(recording.frames()) == [0, 1, 3]
    (loss,) = recording.notes.losses
    assert "a message of /image: JSONDecodeError" in loss
