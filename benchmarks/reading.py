"""Messages a second and memory of reading a recording, against the plain libraries.

    python benchmarks/reading.py [--frames 400] [--size 320x240] [--rounds 3] [--before FOLDER]

A recording of raw images, depth and CameraInfo is made in each storage. Every reader reads all of
it in a process of its own, in turns: `dyfn_ros.recordings`, and `mcap` or `rosbags` themselves, or
`dyfn_ros.recordings` of another checkout.
The rows are CPU time (the best of the rounds) and the peak resident memory above that before
reading; `ratio` is the first over the second.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from dyfn_ros.recordings.typestore import CAMERA_INFO, IMAGE, TYPES, camera_info, image_message
from tests.support.made_recordings import ROS1, ros1_bytes

RATE = 30
OURS, PLAIN, BEFORE = "dyfn_ros", "plain", "before"
# Reads everything; says how many messages, bytes, CPU seconds, and kilobytes above the start.
CHILD = """
import json, resource, sys, time
from pathlib import Path
path, reader = Path(sys.argv[1]), sys.argv[2]
if reader != "plain":
    from dyfn_ros.recordings.storage.open import open_storage
elif path.suffix == ".mcap":
    from mcap.reader import make_reader
elif path.suffix == ".bag":
    from rosbags.rosbag1 import Reader
else:
    from rosbags.rosbag2 import Reader

def sizes():
    if reader != "plain":
        storage = open_storage(path)
        for recorded in storage.messages(storage.topics):
            yield len(recorded.data)
    elif path.suffix == ".mcap":
        with path.open("rb") as file:
            for _, _, message in make_reader(file).iter_messages():
                yield len(message.data)
    else:
        with Reader(path) as opened:
            for _, _, data in opened.messages():
                yield len(data)

def resident():
    return int(next(l for l in open("/proc/self/status") if l.startswith("VmHWM")).split()[1])

before, start, count, size = resident(), time.process_time(), 0, 0
for one in sizes():
    count, size = count + 1, size + one
print(json.dumps([count, size, time.process_time() - start, resident() - before]))
"""


def events(frames: int, size: tuple[int, int]) -> Iterator[tuple[str, str, int, object]]:
    """Topic, type, nanoseconds and message."""
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (size[0], size[1], 3), np.uint8)
    matrix = np.array([[250.0, 0, size[1] / 2], [0, 250.0, size[0] / 2], [0, 0, 1]])
    for index in range(frames):
        stamp = (index + 1) * 1_000_000_000 // RATE
        image = np.roll(noise, index, axis=1)
        depth = image[..., 0].astype(np.uint16) * 20
        yield "/camera/image", IMAGE, stamp, image_message(image, "rgb8", stamp, "camera")
        yield "/camera/depth", IMAGE, stamp, image_message(depth, "16UC1", stamp, "camera")
        info = camera_info(matrix, size, stamp, "camera")
        yield "/camera/camera_info", CAMERA_INFO, stamp, info


def write_rosbag2(path: Path, plugin: StoragePlugin, frames: int, size: tuple[int, int]) -> Path:
    """A folder; MCAP in zstd chunks. Of MCAP the path of the file is given."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    if plugin == StoragePlugin.MCAP:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, object] = {}
        for topic, kind, stamp, message in events(frames, size):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(connections[topic], stamp, TYPES.serialize_cdr(message, kind))
    return next(path.glob("*.mcap")) if plugin == StoragePlugin.MCAP else path


def write_bag1(path: Path, frames: int, size: tuple[int, int]) -> Path:
    """A ROS 1 bag without compression."""
    with Bag1Writer(path) as writer:
        connections: dict[str, object] = {}
        for topic, kind, stamp, message in events(frames, size):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            writer.write(connections[topic], stamp, ros1_bytes(message, kind))
    return path


def measure(path: Path, reader: str, checkout: Path) -> tuple[int, int, float, float]:
    """Messages, bytes, CPU seconds, MB above the start, by the code of a checkout."""
    command = [sys.executable, "-c", CHILD, str(path), reader]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    out = subprocess.run(
        command, capture_output=True, text=True, check=True, env=environment, cwd=path.parent
    ).stdout
    count, size, seconds, kilobytes = json.loads(out)
    return count, size, seconds, kilobytes / 1024


def main() -> None:
    """Make, read, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--size", default="320x240", help="of images, WIDTHxHEIGHT")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--before", type=Path, help="another checkout, in the plain readers' place")
    options = parser.parse_args()
    here = Path(__file__).resolve().parents[1]
    readers = {OURS: here, PLAIN: here}
    if options.before:
        readers = {OURS: here, BEFORE: options.before.resolve()}
    width, height = map(int, options.size.split("x"))
    size = height, width
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        mcap, sqlite = StoragePlugin.MCAP, StoragePlugin.SQLITE3
        makers: dict[str, Callable[[], Path]] = {
            "MCAP, zstd": lambda: write_rosbag2(folder / "mcap", mcap, options.frames, size),
            "sqlite3": lambda: write_rosbag2(folder / "sqlite", sqlite, options.frames, size),
            "ROS 1 bag": lambda: write_bag1(folder / "walk.bag", options.frames, size),
        }
        print("storage       reader    messages/s    MB/s   peak MB")
        for storage, make in makers.items():
            path = make()
            rounds = [
                [measure(path, reader, place) for reader, place in readers.items()]
                for _ in range(options.rounds)
            ]
            best = [min((one[k] for one in rounds), key=lambda found: found[2]) for k in (0, 1)]
            for reader, (count, total, seconds, peak) in zip(readers, best, strict=True):
                speed = f"{count / seconds:12.0f}{total / seconds / 1e6:9.0f}{peak:9.1f}"
                print(f"{storage:14}{reader:8}{speed}")
            assert best[0][0] == best[1][0], "both read the same messages"
            ratio = best[1][2] / best[0][2], best[0][3] / max(best[1][3], 0.1)
            print(f"{storage:14}ratio   {ratio[0]:12.2f}{'':9}{ratio[1]:9.2f}")


if __name__ == "__main__":
    main()
