"""What a file is by its first bytes, whatever its name says."""

from __future__ import annotations

from pathlib import Path

from dyfn_core.data.files import LFS_POINTER
from dyfn_ros.recordings.errors import RecordingError

KINDS = {b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3", b"#ROSBAG V2.0\n": ".bag"}
NAMES = {".mcap": "an MCAP file", ".db3": "an SQLite file", ".bag": "a ROS 1 bag (2.0)"}
_ZSTD = b"\x28\xb5\x2f\xfd"
_OTHERS = {
    LFS_POINTER: "a Git LFS pointer: `git lfs pull` fetches the recording",
    b"PK\x03\x04": "a zip archive: unpack it",
    b"7z\xbc\xaf\x27\x1c": "a 7z archive: unpack it",
    b"Rar!": "a RAR archive: unpack it",
    b"\x1f\x8b": "a gzip file: unpack it",
    b"BZh": "a bzip2 file: unpack it",
    b"\xfd7zXZ": "an xz file: unpack it",
    b"#ROSBAG V1": "a ROS 1 bag of format 1: `rosbag fix` makes one of format 2.0",
    b"#ROSRECORD V1": "a ROS 1 bag of format 1: `rosbag fix` makes one of format 2.0",
}
_MARKUP = (b"<!doctype", b"<html", b"<?xml", b"<head")
_TAR = (b"ustar", 257)
_LENGTH = 512


def kind_by_head(path: Path, packed: bool) -> str | None:
    """The suffix of the format that a file has by its first bytes; None when they say nothing.

    packed: whether its name says zstd. Raises RecordingError when the file is known to be
    something else.
    """
    with path.open("rb") as file:
        head = file.read(_LENGTH)
    for magic, text in _OTHERS.items():
        if head.startswith(magic):
            raise RecordingError(f"{path} is no recording but {text}")
    if head.startswith(_ZSTD) and not packed:
        raise RecordingError(f"{path} is compressed by zstd: name it {path.name}.zstd")
    if head.lstrip(b"\xef\xbb\xbf \r\n\t").lower().startswith(_MARKUP):
        raise RecordingError(f"{path} is no recording but a web page, it {_beginning(head)}")
    if head[_TAR[1] :].startswith(_TAR[0]):
        raise RecordingError(f"{path} is no recording but a tar archive: unpack it")
    return next((kind for magic, kind in KINDS.items() if head.startswith(magic)), None)


def strange_head(path: Path, suffix: str) -> str:
    """Says that a file begins in another way than its format; "" when it does not."""
    with path.open("rb") as file:
        head = file.read(_LENGTH)
    magic = next((magic for magic, kind in KINDS.items() if kind == suffix), None)
    if magic is None or head.startswith(magic):
        return ""
    return f"does not begin as {NAMES[suffix]} does, it {_beginning(head)}"


def _beginning(head: bytes) -> str:
    text = head[:16]
    return f"begins with {text.decode('ascii')!r}" if text.isascii() else f"begins with {text!r}"
