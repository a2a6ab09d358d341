"""Small recordings of every storage there is, each message with its number in it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from dyfn_ros.recordings.typestore import CAMERA_INFO, IMAGE, TYPES, image_message

SIZE = (24, 32)
STEP_NS = 100_000_000
TOPIC = "/image"
ROS1 = get_typestore(Stores.ROS1_NOETIC)


def shade(index: int) -> np.ndarray:
    """Noise, so that it does not compress, with the number in its first pixel."""
    image = np.random.default_rng(index).integers(0, 255, (*SIZE, 3), np.uint8)
    image[0, 0] = index % 256
    return image


def stamp_ns(index: int) -> int:
    return 1_000_000_000 + index * STEP_NS


def image_bytes(index: int) -> bytes:
    message = image_message(shade(index), "rgb8", stamp_ns(index), "camera")
    return bytes(TYPES.serialize_cdr(message, IMAGE))


def write_rosbag2(
    path: Path, indices: range, plugin: StoragePlugin, mode: CompressionMode = CompressionMode.NONE
) -> None:
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, IMAGE, typestore=TYPES)
        for index in indices:
            writer.write(connection, stamp_ns(index), image_bytes(index))


def write_mcap(
    path: Path,
    indices: range,
    *,
    compression: CompressionType = CompressionType.ZSTD,
    chunks: bool = True,
    indexed: bool = True,
) -> None:
    """Two messages a chunk, with checksums."""
    with path.open("wb") as file:
        writer = McapWriter(
            file,
            chunk_size=2 * len(image_bytes(0)),
            compression=compression,
            use_chunking=chunks,
            index_types=IndexType.ALL if indexed else IndexType.NONE,
            use_statistics=indexed,
            use_summary_offsets=indexed,
            repeat_channels=indexed,
            repeat_schemas=indexed,
        )
        writer.start("ros2")
        definition, _ = TYPES.generate_msgdef(IMAGE, ros_version=2)
        schema = writer.register_schema(IMAGE, "ros2msg", definition.encode())
        channel = writer.register_channel(TOPIC, "cdr", schema)
        for index in indices:
            writer.add_message(channel, stamp_ns(index), image_bytes(index), stamp_ns(index), index)
        writer.finish()


def ros1_bytes(message: Any, kind: str) -> bytes:
    """An Image or a CameraInfo of ROS 2 as ROS 1 serialises it."""
    fields = {n: getattr(message, n) for n in message.__dataclass_fields__ if n != "__msgtype__"}
    stamp = ROS1.types["builtin_interfaces/msg/Time"](
        message.header.stamp.sec, message.header.stamp.nanosec
    )
    fields["header"] = ROS1.types["std_msgs/msg/Header"](0, stamp, message.header.frame_id)
    if kind == CAMERA_INFO:
        fields = {n.upper() if len(n) == 1 else n: value for n, value in fields.items()}
    return bytes(ROS1.serialize_ros1(ROS1.types[kind](**fields), kind))


def write_bag1(
    path: Path, indices: range, compression: Bag1Writer.CompressionFormat | None = None
) -> None:
    writer = Bag1Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    writer.chunk_threshold = 2 * len(image_bytes(0))
    with writer:
        connection = writer.add_connection(TOPIC, IMAGE, typestore=ROS1)
        for index in indices:
            message = image_message(shade(index), "rgb8", stamp_ns(index), "camera")
            writer.write(connection, stamp_ns(index), ros1_bytes(message, IMAGE))


def write_split(path: Path, indices: range) -> None:
    """A folder of three files; the metadata says their order, which is not that of the names."""
    path.mkdir()
    third = len(indices) // 3
    parts = [indices[:third], indices[third : 2 * third], indices[2 * third :]]
    names = ["c.mcap", "a.mcap", "b.mcap"]
    for name, part in zip(names, parts, strict=True):
        write_mcap(path / name, part)
    listed = "".join(f"\n  - old_folder/{name}" for name in names)
    text = f"rosbag2_bagfile_information:\n  version: 3\n  relative_file_paths:{listed}\n"
    (path / "metadata.yaml").write_text(text)


def write_packed(path: Path, indices: range) -> None:
    plain = path.with_suffix("")
    write_mcap(plain, indices)
    path.write_bytes(zstandard.compress(plain.read_bytes()))
    plain.unlink()


SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
MESSAGE, FILE = CompressionMode.MESSAGE, CompressionMode.FILE
NONE, LZ4 = CompressionType.NONE, CompressionType.LZ4
BAG1 = Bag1Writer.CompressionFormat
MAKERS: dict[str, Callable[[Path, range], None]] = {
    "sqlite3": partial(write_rosbag2, plugin=SQLITE),
    "sqlite3-message-zstd": partial(write_rosbag2, plugin=SQLITE, mode=MESSAGE),
    "sqlite3-file-zstd": partial(write_rosbag2, plugin=SQLITE, mode=FILE),
    "mcap": partial(write_rosbag2, plugin=MCAP, mode=CompressionMode.STORAGE),
    "mcap-message-zstd": partial(write_rosbag2, plugin=MCAP, mode=MESSAGE),
    "mcap-file-zstd": partial(write_rosbag2, plugin=MCAP, mode=FILE),
    "split": write_split,
    "zstd.mcap": write_mcap,
    "lz4.mcap": partial(write_mcap, compression=LZ4),
    "plain.mcap": partial(write_mcap, compression=NONE),
    "unindexed.mcap": partial(write_mcap, indexed=False),
    "unchunked.mcap": partial(write_mcap, chunks=False),
    "packed.mcap.zstd": write_packed,
    "plain.bag": write_bag1,
    "bz2.bag": partial(write_bag1, compression=BAG1.BZ2),
    "lz4.bag": partial(write_bag1, compression=BAG1.LZ4),
}


def make(folder: Path, kind: str, count: int) -> Path:
    """A recording of count images at 10 Hz."""
    path = folder / kind
    MAKERS[kind](path, range(count))
    return path


def largest_file(path: Path) -> Path:
    """The file with the messages in it."""
    if path.is_file():
        return path
    return max((f for f in path.iterdir() if f.is_file()), key=lambda f: f.stat().st_size)
