"""Recordings whose files or messages are unusual, in the forms that docs/recordings.md lists.

Each maker takes a folder that is empty and gives the path to open.
"""

from __future__ import annotations

import gzip
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import zstandard
from rosbags.rosbag1 import Reader as Bag1Reader
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer

from dyfn_ros.recordings.typestore import IMAGE, TYPES, Lens, header
from tests.support.formats_of_bags import (
    COLOUR,
    COUNT,
    TRUTH,
    Event,
    Maker,
    bag,
    bag1,
    bare,
    beginning,
    colours,
    image,
    in_mcap,
    infos,
    millimetres,
    of,
    parts,
    stamp,
    truths,
    whole,
)
from tests.support.made_recordings import ROS1
from tests.support.numbered import depth, picture

BARREL = Lens("plumb_bob", (-0.3, 0.1, 0.0, 0.0, 0.0))
SKIPPED = struct.pack("<II", 0x184D2A50, 4) + b"what"  # a frame of zstd that holds no data


def reversed_list(folder: Path) -> Path:
    made = parts(folder, (0, 1, 2, 3), True)
    head, *names = (made / "metadata.yaml").read_text().split("\n  - ")
    text = "\n  - ".join([head, *(name.strip() for name in reversed(names))])
    (made / "metadata.yaml").write_text(text)
    return made


def twins(folder: Path) -> Path:
    made = folder / "walk"
    made.mkdir()
    for plugin, suffix in ((StoragePlugin.MCAP, "mcap"), (StoragePlugin.SQLITE3, "db3")):
        path = next(bag(folder / suffix, whole(), plugin).glob(f"*.{suffix}"))
        path.rename(made / f"walk.{suffix}")
    return made


def copied(folder: Path) -> Path:
    path = bare(folder)
    made = folder / "walk"
    made.mkdir()
    shutil.copy(path, made / "walk (1).mcap")
    path.rename(made / "walk.mcap")
    return made


def many_frames(folder: Path) -> Path:
    data = bare(folder).read_bytes()
    pieces = [data[at : at + 1000] for at in range(0, len(data), 1000)]
    path = folder / "packed.mcap.zst"
    path.write_bytes(b"".join(SKIPPED + zstandard.compress(piece) for piece in pieces))
    return path


def broken_link(folder: Path) -> Path:
    made = bag(folder / "bag", whole())
    path = next(made.glob("*.mcap"))
    path.unlink()
    path.symlink_to(folder / "elsewhere.mcap")
    return made


def gzipped(folder: Path) -> Path:
    path = folder / "walk.bag.gz"
    path.write_bytes(gzip.compress(bag1(folder / "walk.bag", whole()).read_bytes()))
    return path


def serialised(
    folder: Path,
    change: Callable[[Event, bytes], bytes],
    little_endian: bool = True,
    events: Callable[[], list[Event]] = whole,
) -> Path:
    """A rosbag2 folder of messages whose bytes are changed."""
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for event in events():
            key = event.topic, event.kind
            known = {(c.topic, c.msgtype): c for c in writer.connections}
            connection = known.get(key) or writer.add_connection(*key, typestore=TYPES)
            data = TYPES.serialize_cdr(event.message, event.kind, little_endian=little_endian)
            writer.write(connection, event.log_ns, change(event, bytes(data)))
    return folder / "bag"


def big_endian_cdr(folder: Path) -> Path:
    return serialised(folder, lambda event, data: data, little_endian=False)


def big_endian_pixels() -> list[Event]:
    events = truths(pixels=lambda i: millimetres(i).byteswap())
    for event in events:
        event.message.is_bigendian = 1
    return [*colours(), *infos(), *events]


def rectified() -> list[Event]:
    """P is that of the images, K and D of those that they were made of."""
    described = infos(lens=BARREL)
    for event in described:
        event.message.k = event.message.k * np.array([2, 1, 1, 1, 2, 1, 1, 1, 1.0])
    return [*colours("/cam/image_rect_color"), *described, *truths("/cam/depth/image_rect")]


def with_top(pixels: Callable[[int], np.ndarray], value: float) -> Callable[[int], np.ndarray]:
    """A third of the rows have this value."""

    def made(index: int) -> np.ndarray:
        found = pixels(index).copy()
        found[:8] = value
        return found

    return made


def padded() -> list[Event]:
    """Rows that are longer in the file than in the picture."""
    events = []
    for index in range(COUNT):
        wide = cv2.copyMakeBorder(picture(index), 0, 0, 0, 8, cv2.BORDER_CONSTANT)
        message = image(wide, "rgb8", stamp(index))
        message.width -= 8
        events.append(Event(COLOUR, IMAGE, stamp(index), message))
    return [*events, *truths()]


def binned() -> list[Event]:
    described = infos(size=(48, 64))
    for event in described:
        event.message.binning_x = event.message.binning_y = 2
        event.message.k = np.array([80, 0, 31.5, 0, 80, 23.5, 0, 0, 1.0])
    return [*colours(), *truths(), *described]


def uncalibrated() -> list[Event]:
    described = infos()
    for event in described:
        event.message.k = np.zeros(9)
    return [*colours(), *truths(), *described]


def cut_depth(folder: Path) -> Path:
    """Of each message of depth only the beginning is there."""
    return serialised(folder, lambda event, data: data[:30] if event.topic == TRUTH else data)


def cut_other_depth(folder: Path) -> Path:
    """The same of another topic of depth, beside one that can be read."""
    other = "/cam/depth/second"
    return serialised(
        folder,
        lambda event, data: data[:30] if event.topic == other else data,
        events=lambda: [*whole(), *truths(other)],
    )


def other_cdr(folder: Path) -> Path:
    """A head that says XCDR 2, which aligns numbers of 8 bytes in another way."""
    return serialised(folder, lambda event, data: b"\0\7" + data[2:])


def clouds() -> list[Event]:
    kind = "sensor_msgs/msg/PointCloud2"
    fields = [
        TYPES.types["sensor_msgs/msg/PointField"](name=name, offset=4 * at, datatype=7, count=1)
        for at, name in enumerate("xyz")
    ]
    found = []
    for index in range(COUNT):
        cloud = TYPES.types[kind](
            header=header(stamp(index), "lidar"),
            height=1,
            width=2,
            fields=fields,
            is_bigendian=False,
            point_step=12,
            row_step=24,
            data=np.ones(6, np.float32).view(np.uint8),
            is_dense=True,
        )
        found.append(Event("/points", kind, stamp(index), cloud))
    return found


def realsense(folder: Path) -> Path:
    """A bag of the SDK, whose sensor counts tenths of millimetres."""
    sensor = "/device_0/sensor_0"
    events = [
        *colours("/device_0/sensor_1/Color_0/image/data"),
        *infos("/device_0/sensor_1/Color_0/info/camera_info"),
        *truths(f"{sensor}/Depth_0/image/data", "mono16", lambda i: 10 * millimetres(i)),
    ]
    path = bag1(folder / "walk.bag", events)
    unit = f"{sensor}/option/Depth_Units/value"
    with Bag1Writer(folder / "unit.bag") as writer:
        connection = writer.add_connection(unit, "std_msgs/msg/Float32", typestore=ROS1)
        writer.write(connection, 1, struct.pack("<f", 1e-4))
        with Bag1Reader(path) as reader:
            topics = {
                c.topic: writer.add_connection(c.topic, c.msgtype, typestore=ROS1)
                for c in reader.connections
            }
            for known, at, data in reader.messages():
                writer.write(topics[known.topic], at, data)
    return folder / "unit.bag"


FILES: dict[str, Maker] = {
    "split, listed in another order": reversed_list,
    "the same as `.mcap` and `.db3`, no `metadata.yaml`": twins,
    "a file and its copy (`walk (1).mcap`), no `metadata.yaml`": copied,
    "message encoding in capitals (`CDR`)": in_mcap("CDR", "{0}/msg/{1}"),
    "`.mcap.zst` of many frames (pzstd)": many_frames,
    "a link that leads nowhere": broken_link,
    "`.bag.gz`": gzipped,
    "git-annex pointer": beginning(b"../.git/annex/objects/0p/SHA256E-s9--ab.mcap\n", "walk.mcap"),
    "CDR, most significant byte first": big_endian_cdr,
    "CDR that says to be XCDR 2": other_cdr,
}
MESSAGES: dict[str, Maker] = {
    "`image_rect...` with a CameraInfo that has a lens": of(rectified),
    "65535 in 16UC1": of(
        lambda: [*colours(), *infos(), *truths(pixels=with_top(millimetres, 65535))]
    ),
    "one far value for no depth (1000 m, 65504 m)": of(
        lambda: [*colours(), *truths(encoding="32FC1", pixels=with_top(depth, 1000))]
    ),
    "16UC1, most significant byte first": of(big_endian_pixels),
    "rows with padding": of(padded),
    "CameraInfo with binning": of(binned),
    "CameraInfo with K all 0": of(uncalibrated),
    "depth whose messages cannot be read": cut_depth,
    "the same beside depth that can be read": cut_other_depth,
    "PointCloud2 and no depth image": of(lambda: [*colours(), *clouds()]),
    "RealSense SDK, depth in tenths of millimetres": realsense,
}
