"""What a file is by its first bytes, whatever its name says."""

from __future__ import annotations

from pathlib import Path

from dyfn_core.data.heads import HEAD, beginning, told_by_head
from dyfn_ros.recordings.errors import RecordingError

KINDS = {b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3", b"#ROSBAG V2.0\n": ".bag"}
NAMES = {".mcap": "an MCAP file", ".db3": "an SQLite file", ".bag": "a ROS 1 bag (2.0)"}
_ZSTD = b"\x28\xb5\x2f\xfd"
_OLD_BAG = (b"#ROSBAG V1", b"#ROSRECORD V1")


def kind_by_head(path: Path, packed: bool) -> str | None:
    """The suffix of the format that a file has by its first bytes; None when they say nothing.

    packed: whether its name says zstd. Raises RecordingError when the file is known to be
    something else.
    """
    with path.open("rb") as file:
        head = file.read(HEAD)
    told = told_by_head(path, "recording")
    if head.startswith(_OLD_BAG):
        told = "a ROS 1 bag of format 1: `rosbag fix` makes one of format 2.0"
    if told:
        raise RecordingError(f"{path} is no recording but {told}")
    if head.startswith(_ZSTD) and not packed:
        raise RecordingError(f"{path} is compressed by zstd: name it {path.name}.zstd")
    return next((kind for magic, kind in KINDS.items() if head.startswith(magic)), None)


def strange_head(path: Path, suffix: str) -> str:
    """Says that a file begins in another way than its format; "" when it does not."""
    with path.open("rb") as file:
        head = file.read(HEAD)
    magic = next((magic for magic, kind in KINDS.items() if kind == suffix), None)
    if magic is None or head.startswith(magic):
        return ""
    return f"does not begin as {NAMES[suffix]} does, it {beginning(head)}"
