"""Recordings of ROS messages in the forms that docs/recordings.md lists, of tests.support.numbered.

Each maker takes a folder that is empty and gives the path to open.
"""

from __future__ import annotations

import base64
import json
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FOXGLOVE_CALIBRATION,
    FOXGLOVE_COMPRESSED,
    FOXGLOVE_RAW,
    IMAGE,
    TYPES,
    Lens,
    camera_info,
    compressed_message,
    depth_to_millimetres,
    header,
    image_message,
)
from tests.support.made_recordings import ROS1, ros1_bytes
from tests.support.numbered import CAMERA, SECOND, SIZE, depth, picture
from tests.support.rvl import encode_rvl

COUNT = 4
COLOUR, TRUTH, INFO = "/cam/image_raw", "/cam/depth/image_raw", "/cam/camera_info"
Maker = Callable[[Path], Path]


class Event(NamedTuple):
    """A message that is recorded: topic, type, header's stamp or a later time, message."""

    topic: str
    kind: str
    log_ns: int
    message: Any


def stamp(index: int) -> int:
    return SECOND + index * SECOND // 10


def millimetres(index: int) -> np.ndarray:
    return depth_to_millimetres(depth(index))


def png(pixels: np.ndarray) -> np.ndarray:
    return cv2.imencode(".png", pixels)[1].reshape(-1)


def image(pixels: np.ndarray, encoding: str, stamp_ns: int, frame_id: str = "camera") -> Any:
    return image_message(pixels, encoding, stamp_ns, frame_id)


def colours(topic: str = COLOUR) -> list[Event]:
    return [
        Event(topic, IMAGE, stamp(i), image(picture(i), "rgb8", stamp(i))) for i in range(COUNT)
    ]


def truths(
    topic: str = TRUTH,
    encoding: str = "16UC1",
    pixels: Callable[[int], np.ndarray] = millimetres,
    late_ns: int = 0,
    frame_id: str = "camera",
) -> list[Event]:
    """late_ns: what is added to the headers' stamps."""
    return [
        Event(topic, IMAGE, stamp(i), image(pixels(i), encoding, stamp(i) + late_ns, frame_id))
        for i in range(COUNT)
    ]


def packed(topic: str, layout: str, data: Callable[[int], np.ndarray]) -> list[Event]:
    return [
        Event(
            topic,
            COMPRESSED_IMAGE,
            stamp(i),
            compressed_message(data(i), layout, stamp(i), "camera"),
        )
        for i in range(COUNT)
    ]


def infos(
    topic: str = INFO, size: tuple[int, int] = SIZE, frame: str = "camera", lens: Lens | None = None
) -> list[Event]:
    return [
        Event(topic, CAMERA_INFO, stamp(i), camera_info(CAMERA, size, stamp(i), frame, lens))
        for i in range(COUNT)
    ]


def whole() -> list[Event]:
    return [*colours(), *truths(), *infos()]


def bag(
    path: Path,
    events: Iterable[Event],
    plugin: StoragePlugin = StoragePlugin.MCAP,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A rosbag2 folder."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for event in sorted(events, key=lambda event: event.log_ns):
            key = event.topic, event.kind
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=TYPES)
            data = TYPES.serialize_cdr(event.message, event.kind)
            writer.write(connections[key], event.log_ns, data)
    return path


def of(events: Callable[[], Iterable[Event]]) -> Maker:
    return lambda folder: bag(folder / "bag", events())


def bag1(path: Path, events: Iterable[Event]) -> Path:
    with Bag1Writer(path) as writer:
        connections: dict[str, Any] = {}
        for event in sorted(events, key=lambda event: event.log_ns):
            if event.topic not in connections:
                connections[event.topic] = writer.add_connection(
                    event.topic, event.kind, typestore=ROS1
                )
            data = ros1_bytes(event.message, event.kind)
            writer.write(connections[event.topic], event.log_ns, data)
    return path


class Channel(NamedTuple):
    """Of an MCAP file: topic, encoding, schema's name and data, the message of a number."""

    topic: str
    encoding: str
    schema: str
    data: bytes
    message: Callable[[int], bytes | None]


def mcap(path: Path, channels: list[Channel]) -> Path:
    """A channel's message of a number may be None: none."""
    with path.open("wb") as file:
        writer = McapWriter(file, compression=CompressionType.ZSTD, chunk_size=4096)
        writer.start()
        keys = [
            writer.register_channel(
                channel.topic,
                channel.encoding,
                writer.register_schema(channel.schema, channel.encoding, channel.data),
            )
            for channel in channels
        ]
        for index in range(COUNT):
            for key, channel in zip(keys, channels, strict=True):
                data = channel.message(index)
                if data is not None:
                    writer.add_message(key, stamp(index), data, stamp(index))
        writer.finish()
    return path


def as_channel(events: list[Event], encoding: str, style: str) -> Channel:
    """The events of one topic; style: of the type's name."""
    package, _, name = events[0].kind.split("/")
    by_number = {(event.log_ns - stamp(0)) // (SECOND // 10): event for event in events}
    write = ros1_bytes if encoding == "ros1" else TYPES.serialize_cdr

    def message(index: int) -> bytes | None:
        event = by_number.get(index)
        return None if event is None else bytes(write(event.message, event.kind))

    return Channel(events[0].topic, encoding, style.format(package, name), b"", message)


def in_mcap(encoding: str, style: str) -> Maker:
    return lambda folder: mcap(
        folder / "walk.mcap",
        [as_channel(events, encoding, style) for events in (colours(), truths(), infos())],
    )


def bare(folder: Path) -> Path:
    made = bag(folder / "bag", whole())
    return next(made.glob("*.mcap")).rename(folder / "walk.mcap")


def packed_file(folder: Path) -> Path:
    path = bare(folder)
    path.with_suffix(".mcap.zstd").write_bytes(zstandard.compress(path.read_bytes()))
    return path.with_suffix(".mcap.zstd")


def upper_case(folder: Path) -> Path:
    return bare(folder).rename(folder / "WALK.MCAP")


def cut(folder: Path) -> Path:
    path = bare(folder)
    path.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])
    return path


def write_ahead(folder: Path) -> Path:
    """A database whose rows are in the log beside it."""
    made = next(bag(folder / "bag", whole(), StoragePlugin.SQLITE3).glob("*.db3"))
    database = sqlite3.connect(made)
    database.execute("PRAGMA journal_mode = wal")
    database.execute("PRAGMA wal_autocheckpoint = 0")
    database.execute("UPDATE messages SET timestamp = timestamp")
    database.commit()
    copy = folder / "walk.db3"
    for suffix in ("", "-wal"):
        shutil.copy(f"{made}{suffix}", f"{copy}{suffix}")
    database.close()
    return copy


def rows_missing(folder: Path) -> Path:
    """A database with fewer messages than metadata.yaml counts."""
    made = bag(folder / "bag", whole(), StoragePlugin.SQLITE3)
    with sqlite3.connect(next(made.glob("*.db3"))) as database:
        database.execute("DELETE FROM messages WHERE timestamp > ?", (stamp(1),))
    database.close()
    return made


def parts(folder: Path, kept: tuple[int, ...], metadata: bool) -> Path:
    """One message a topic in each of four files, of which some are there."""
    made = folder / "walk"
    made.mkdir()
    for number in kept:
        events = [event for event in whole() if event.log_ns == stamp(number)]
        path = next(bag(folder / f"bag{number}", events).glob("*.mcap"))
        path.rename(made / f"walk_{number}.mcap")
    if metadata:
        listed = "".join(f"\n  - walk_{number}.mcap" for number in range(COUNT))
        text = f"rosbag2_bagfile_information:\n  relative_file_paths:{listed}\n"
        (made / "metadata.yaml").write_text(text)
    return made


def moved(folder: Path) -> Path:
    made = bag(folder / "bag", whole())
    path = next(made.glob("*.mcap"))
    (made / "data").mkdir()
    path.rename(made / "data" / path.name)
    text = (made / "metadata.yaml").read_text().replace(path.name, f"data/{path.name}")
    (made / "metadata.yaml").write_text(text)
    return made


def renamed(folder: Path) -> Path:
    made = bag(folder / "bag", whole())
    next(made.glob("*.mcap")).rename(made / "by_hand.mcap")
    return made


def hidden(folder: Path) -> Path:
    made = bag(folder / "bag", whole())
    path = next(made.glob("*.mcap"))
    (made / f"._{path.name}").write_bytes(b"\0\5\x16\7")
    (made / "metadata.yaml").unlink()
    return made


def marked(folder: Path) -> Path:
    return bag(folder / "walk #1?50%41", whole())


def beginning(data: bytes, name: str) -> Maker:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(data)
        return folder / name

    return make


def json_of_ros(folder: Path) -> Path:
    channel = Channel(COLOUR, "json", "sensor_msgs/msg/Image", b"{}", lambda index: b"{}")
    return mcap(folder / "walk.mcap", [channel])


def two_encodings(folder: Path) -> Path:
    """Every second image as ROS 1 has it, on one topic."""
    halves = colours()[::2], colours()[1::2]
    channels = [
        as_channel(halves[0], "cdr", "{0}/msg/{1}"),
        as_channel(halves[1], "ros1", "{0}/{1}"),
        as_channel(truths(), "cdr", "{0}/msg/{1}"),
    ]
    return mcap(folder / "walk.mcap", channels)


def two_types(folder: Path) -> Path:
    jpegs = packed(COLOUR, "png", lambda i: png(picture(i)))[1::2]
    channels = [as_channel(events, "cdr", "{0}/msg/{1}") for events in (colours()[::2], jpegs)]
    return mcap(folder / "walk.mcap", channels)


def foxglove_fields(index: int) -> dict[str, dict[str, Any]]:
    """By type: the fields of a message of Foxglove's but for its time."""
    size = {"width": SIZE[1], "height": SIZE[0]}
    info, raw = infos()[index].message, truths()[index].message
    arrays = {name: getattr(info, name) for name in "dkrp"}
    return {
        FOXGLOVE_COMPRESSED: {"format": "png", "data": png(picture(index)[..., ::-1])},
        FOXGLOVE_RAW: {"encoding": "16UC1", "step": int(raw.step), "data": raw.data, **size},
        FOXGLOVE_CALIBRATION: {"distortion_model": "plumb_bob", **arrays, **size},
    }


FOXGLOVE_TOPICS = {
    COLOUR: FOXGLOVE_COMPRESSED,
    TRUTH: FOXGLOVE_RAW,
    INFO: FOXGLOVE_CALIBRATION,
}


def foxglove_json(folder: Path) -> Path:
    def message(kind: str, index: int) -> bytes:
        sec, nsec = divmod(stamp(index), SECOND)
        content: dict[str, Any] = {
            "timestamp": {"sec": sec, "nsec": nsec},
            "frame_id": "camera",
        }
        for name, value in foxglove_fields(index)[kind].items():
            if name == "data":
                value = base64.b64encode(bytes(value)).decode()
            is_array = isinstance(value, np.ndarray)
            content[name.upper() if is_array else name] = value.tolist() if is_array else value
        return json.dumps(content).encode()

    return mcap(
        folder / "walk.mcap",
        [
            Channel(
                topic,
                "json",
                f"foxglove.{kind.split('/')[-1]}",
                b"{}",
                lambda index, kind=kind: message(kind, index),
            )
            for topic, kind in FOXGLOVE_TOPICS.items()
        ],
    )


def foxglove_ros(plugin: StoragePlugin) -> Maker:
    def events() -> Iterator[Event]:
        for index in range(COUNT):
            fields = foxglove_fields(index)
            time = header(stamp(index), "").stamp
            for topic, kind in FOXGLOVE_TOPICS.items():
                made = TYPES.types[kind](timestamp=time, frame_id="camera", **fields[kind])
                yield Event(topic, kind, stamp(index), made)

    return lambda folder: bag(folder / "bag", events(), plugin)


def compressed_depth(layout: str, codec: Callable[[np.ndarray], bytes]) -> list[Event]:
    topic = f"{TRUTH}/compressedDepth"

    def data(index: int) -> np.ndarray:
        content = struct.pack("<iff", 0, 0, 0) + codec(millimetres(index))
        return np.frombuffer(content, np.uint8)

    return [*colours(), *infos(), *packed(topic, layout, data)]


def one_stamp(events: list[Event], late_ns: int) -> list[Event]:
    """As recorded by a driver that writes 0 into the headers."""
    for event in events:
        event.message.header.stamp = header(0, "").stamp
    return [event._replace(log_ns=event.log_ns + late_ns) for event in events]


def shifted(seconds: float) -> list[Event]:
    """Depth whose headers are this much after those of the images recorded with them."""
    return [*colours(), *truths(late_ns=round(seconds * SECOND))]


def without_messages(folder: Path) -> Path:
    path = folder / "bag"
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic in (COLOUR, f"{COLOUR}/compressed"):
            kind = COMPRESSED_IMAGE if topic.endswith("compressed") else IMAGE
            connection = writer.add_connection(topic, kind, typestore=TYPES)
            for event in colours() if kind == IMAGE else []:
                data = TYPES.serialize_cdr(event.message, kind)
                writer.write(connection, event.log_ns, data)
    return path


SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
MESSAGE, FILE = CompressionMode.MESSAGE, CompressionMode.FILE
RGB = "/camera/color/image_raw"
GREY = np.full(SIZE, 7, np.uint8)

BAGS: dict[str, Maker] = {
    "rosbag2 folder, MCAP": of(whole),
    "rosbag2 folder, sqlite3": lambda folder: bag(folder / "bag", whole(), SQLITE),
    "rosbag2 folder, compressed by message": lambda folder: bag(
        folder / "bag", whole(), SQLITE, MESSAGE
    ),
    "rosbag2 folder, compressed by file": lambda folder: bag(folder / "bag", whole(), MCAP, FILE),
    "bare `.mcap`": bare,
    "`.mcap.zstd`": packed_file,
    "suffix in capitals": upper_case,
    "bare `.db3`, rows in its write-ahead log": write_ahead,
    "ROS 1 bag": lambda folder: bag1(folder / "walk.bag", whole()),
    "split, without `metadata.yaml`": lambda folder: parts(folder, (0, 1, 2, 3), False),
    "split, a part missing by its number": lambda folder: parts(folder, (0, 1, 3), False),
    "split, a listed part missing": lambda folder: parts(folder, (0, 1, 2), True),
    "file in a sub-folder, as `metadata.yaml` says": moved,
    "file renamed, as many messages": renamed,
    "fewer messages than `metadata.yaml` counts": rows_missing,
    "companions (`._walk.mcap`), no `metadata.yaml`": hidden,
    "`#`, `?` or `%` in the name": marked,
    "file cut off": cut,
    "Git LFS pointer": beginning(b"version https://git-lfs.github.com/spec/v1\noid\n", "walk.mcap"),
    "web page": beginning(b"<!DOCTYPE html><html></html>", "walk.bag"),
    "zip archive": beginning(b"PK\x03\x04" + bytes(60), "walk.mcap"),
    "ROS 1 bag of format 1": beginning(b"#ROSBAG V1.1\n" + bytes(60), "walk.bag"),
    "types `sensor_msgs/Image`": in_mcap("cdr", "{0}/{1}"),
    "types `sensor_msgs::msg::dds_::Image_`": in_mcap("cdr", "{0}::msg::dds_::{1}_"),
    "ROS 1 messages in MCAP": in_mcap("ros1", "{0}/{1}"),
    "Foxglove's types in JSON": foxglove_json,
    "Foxglove's types as ROS messages, MCAP": foxglove_ros(MCAP),
    "Foxglove's types as ROS messages, sqlite3": foxglove_ros(SQLITE),
    "ROS types in JSON": json_of_ros,
    "two encodings on one topic": two_encodings,
    "two types on one topic": two_types,
    "16UC1": of(whole),
    "32FC1": of(lambda: [*colours(), *infos(), *truths(encoding="32FC1", pixels=depth)]),
    "mono16, named depth": of(lambda: [*colours(), *infos(), *truths(encoding="mono16")]),
    "16-bit PNG": of(
        lambda: [
            *colours(),
            *infos(),
            *packed(f"{TRUTH}/compressed", "16UC1; png", lambda i: png(millimetres(i))),
        ]
    ),
    "compressedDepth PNG": of(
        lambda: compressed_depth("16UC1; compressedDepth png", lambda mm: bytes(png(mm)))
    ),
    "compressedDepth RVL": of(lambda: compressed_depth("16UC1; compressedDepth rvl", encode_rvl)),
    "32FC1 in millimetres": of(
        lambda: [
            *colours(),
            *truths(encoding="32FC1", pixels=lambda i: 1000 * depth(i)),
        ]
    ),
    "mono16, not named depth": of(
        lambda: [*colours(), *infos(), *truths("/cam/lidar/image", "mono16")]
    ),
    "16UC1, not named depth": of(lambda: [*colours(), *infos(), *truths("/cam/seen/image")]),
    "depth as JPEG or 8-bit PNG": of(
        lambda: [
            *colours(),
            *packed(f"{TRUTH}/compressed", "png", lambda i: png((10 * depth(i)).astype(np.uint8))),
        ]
    ),
    "depth in another encoding (8UC1, 64FC1, ...)": of(
        lambda: [
            *colours(),
            *truths(encoding="64FC1", pixels=lambda i: depth(i).astype(np.float64)),
        ]
    ),
    "disparity as 32FC1": of(lambda: [*colours(), *truths("/cam/disparity", "32FC1", depth)]),
    "thermal or infrared, 16UC1": of(lambda: [*colours(), *truths("/thermal/image")]),
    "infrared beside colour": of(
        lambda: [*whole(), *truths("/cam/infra1/image", "mono8", lambda i: GREY)]
    ),
    "RealSense: aligned depth beside the sensor's own": of(
        lambda: [
            *colours(RGB),
            *infos("/camera/color/camera_info"),
            *truths("/camera/aligned_depth_to_color/image_raw"),
            *truths("/camera/depth/image_rect_raw", pixels=lambda i: 2 * millimetres(i)),
        ]
    ),
    "two cameras": of(lambda: [*colours("/front/image"), *colours("/rear/image")]),
    "a depth topic of each of two cameras, one colour": of(
        lambda: [
            *colours("/front/color/image"),
            *truths("/front/depth/image"),
            *truths("/rear/depth/image", pixels=lambda i: 2 * millimetres(i)),
        ]
    ),
    "the same with the cameras' namespaces below `/depth`": of(
        lambda: [
            *colours("/camera/front/image"),
            *truths("/depth/front/image"),
            *truths("/depth/rear/image", pixels=lambda i: 2 * millimetres(i)),
        ]
    ),
    "Azure Kinect: `/depth_to_rgb` beside `/depth`": of(
        lambda: [
            *colours("/rgb/image_raw"),
            *truths("/depth_to_rgb/image_raw"),
            *truths("/depth/image_raw", pixels=lambda i: 2 * millimetres(i)),
        ]
    ),
    "depth beside labels of 16 bits": of(
        lambda: [*colours(), *truths(), *truths("/cam/labels", pixels=lambda i: 2 * millimetres(i))]
    ),
    "depth beside depth as 64FC1": of(
        lambda: [
            *colours(),
            *truths(),
            *truths("/cam/depth/exact", "64FC1", lambda i: depth(i).astype(np.float64)),
        ]
    ),
    "colour beside optical flow (32FC2), labels (32SC1)": of(
        lambda: [
            *whole(),
            *truths("/cam/flow", "32FC2", lambda i: np.dstack([depth(i), depth(i)])),
            *truths("/cam/labels", "32SC1", lambda i: millimetres(i).astype(np.int32)),
        ]
    ),
    "the only depth in another camera's namespace": of(
        lambda: [*colours("/front/color/image"), *truths("/rear/depth/image")]
    ),
    "depth of another `frame_id`, without CameraInfo": of(
        lambda: [*colours(), *truths(frame_id="lidar")]
    ),
    "a topic without messages": without_messages,
    "picture of depth alone": of(
        lambda: [*colours("/cam/depth/image_colored")],
    ),
    "the only CameraInfo in another camera's namespace": of(
        lambda: [*colours("/front/image"), *infos("/rear/camera_info"), *truths("/front/depth")]
    ),
    "CameraInfo of another size": of(lambda: [*colours(), *truths(), *infos(size=(480, 640))]),
    "CameraInfo's `frame_id` with a slash": of(
        lambda: [*colours(), *truths(), *infos(frame="/camera")]
    ),
    "CameraInfo of another `frame_id`": of(
        lambda: [*colours(), *truths(), *infos(frame="elsewhere")]
    ),
    "lens `kannala_brandt`, `radtan`": of(
        lambda: [*colours(), *infos(lens=Lens("kannala_brandt", (0.0, 0.0, 0.0, 0.0)))]
    ),
    "another lens": of(
        lambda: [*colours(), *truths(), *infos(lens=Lens("double_sphere", (0.1, 0.2)))]
    ),
    "stamps all 0": of(lambda: [*one_stamp(colours(), 0), *one_stamp(truths(), 1000)]),
    "stamps of depth all 0": of(lambda: [*colours(), *one_stamp(truths(), 1000)]),
    "depth stamped 0.25 s after its images": of(lambda: shifted(0.25)),
    "depth of another clock": of(lambda: shifted(1000.0)),
}
