"""What a storage gives: messages as they were recorded; and the limits of what is believed."""

from __future__ import annotations

import re
import sqlite3
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from rosbags.rosbag1 import ReaderError as Bag1Error
from rosbags.serde import SerdeError

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.typestore import TYPES

# What the readers are known to raise on bytes that are no longer what was written.
DAMAGE = (
    Bag1Error,
    SerdeError,
    McapError,
    zstandard.ZstdError,
    zlib.error,
    sqlite3.Error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    RuntimeError,
    AssertionError,
    ArithmeticError,
    MemoryError,
)
MAX_BYTES = 1 << 28  # of one chunk or message; what claims to be larger is taken for damage
MOST_LOSSES = 20  # sentences
_PIECE = 1 << 20
_STEP = 1 << 10  # of zstd, which makes at most 32 MiB of this
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class Recorded(NamedTuple):
    """One message: log_ns is when it was recorded, data is its CDR bytes.

    to_cdr: what makes them of the bytes of a file, inside a storage; raises one of DAMAGE.
    """

    topic: str
    kind: str
    log_ns: int
    data: bytes
    to_cdr: Callable[[bytes], bytes] | None = None

    def message(self) -> Any:
        """The deserialised message. Raises RecordingError when the bytes are not its type."""
        try:
            return TYPES.deserialize_cdr(self.data, self.kind)
        except DAMAGE as error:
            raise RecordingError(f"{self.topic}: cannot read as {self.kind}: {error!r}") from error


@dataclass(frozen=True)
class Topic:
    """A topic of a recording: message type and how many messages can be read."""

    kind: str
    count: int


class Storage(Protocol):
    """An opened recording.

    topics: name -> Topic. remarks: what is odd about the files and costs no message.
    """

    topics: dict[str, Topic]
    remarks: Sequence[str]

    @property
    def losses(self) -> list[str]:
        """What could not be read, one sentence each; complete after messages() is exhausted."""

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """Messages of these topics in log-time order; equal times in the order of recording."""


class Losses:
    """Sentences about what is lost; of very many, the first and how many more."""

    def __init__(self) -> None:
        self._sentences: list[str] = []
        self._more = 0
        self._others: Counter[tuple[str, str, str]] = Counter()

    def add(self, sentence: str) -> None:
        """One more."""
        if len(self._sentences) < MOST_LOSSES:
            self._sentences.append(sentence)
        else:
            self._more += 1

    def beside(self, topic: str, kind: str, others: str) -> None:
        """A message of another type than the others of its topic."""
        self._others[topic, kind, others] += 1

    @property
    def sentences(self) -> list[str]:
        """All of them."""
        mixed = [
            f"{topic}: {count} messages of {kind} are left out, since the topic's first is of "
            f"{others}"
            for (topic, kind, others), count in self._others.items()
        ]
        return [*self._sentences, *mixed, *([f"and {self._more} more"] if self._more else [])]


def ros_type(name: str) -> str:
    """A message type as ROS 2 writes it now: package/msg/Name.

    Older recordings and other recorders write package/Name, package::msg::Name,
    package.msg.Name or, after DDS, package::msg::dds_::Name_.
    """
    parts = re.split(r"::|[/.]", name)
    inner = parts[1:-1]
    if len(parts) < 2 or any(part not in ("msg", "dds_") for part in inner):
        return name
    last = parts[-1].removesuffix("_") if "dds_" in inner else parts[-1]
    return f"{parts[0]}/msg/{last}"


def count_topics(found: Iterable[Recorded]) -> dict[str, Topic]:
    """Topics by what was read; of a topic with two types, the first counts."""
    kinds: dict[str, str] = {}
    counts: Counter[str] = Counter()
    for recorded in found:
        if kinds.setdefault(recorded.topic, recorded.kind) == recorded.kind:
            counts[recorded.topic] += 1
    return {topic: Topic(kind, counts[topic]) for topic, kind in kinds.items()}


def topics_of(counted: Iterable[tuple[str, str, int]]) -> dict[str, Topic]:
    """Topics by name, type and number of messages of their connections; of a topic with two types,
    the first counts."""
    topics: dict[str, Topic] = {}
    for name, kind, count in counted:
        known = topics.get(name, Topic(kind, 0))
        topics[name] = Topic(known.kind, known.count + (count if known.kind == kind else 0))
    return topics


def reason(error: BaseException) -> str:
    """An exception as part of a sentence."""
    return f"{type(error).__name__} {error}".strip()


def plain(data: bytes) -> bytes:
    """A message's bytes, decompressed when they are zstd (rosbag2's compression by message)."""
    return decompress("zstd", data) if data.startswith(_ZSTD_MAGIC) else data


def decompress(compression: str, data: bytes, *, whole: bool = True) -> bytes:
    """Decompress "zstd", "lz4" or "" in small steps: no length in the data is believed.

    Whole zstd that says to be within MAX_BYTES is decompressed at once, which is faster.

    whole: raise when the data ends early; else what there is is returned.
    Raises one of DAMAGE; ValueError when more than MAX_BYTES come out.
    """
    if compression == "":
        return data
    if compression == "zstd" and whole:
        with suppress(zstandard.ZstdError):  # what is damaged is found again in steps, and named
            if 0 < zstandard.frame_content_size(data) <= MAX_BYTES:
                return zstandard.ZstdDecompressor().decompress(data)
    if compression == "zstd":
        decoder: Any = zstandard.ZstdDecompressor().decompressobj()
    elif compression == "lz4":
        decoder = lz4.frame.LZ4FrameDecompressor()
    else:
        raise ValueError(f"compression {compression!r} is unknown, expected zstd or lz4")
    pieces, size = [], 0
    view = memoryview(data)
    try:
        for piece in _steps(decoder, compression, view):
            pieces.append(piece)
            size += len(piece)
            if size > MAX_BYTES:
                raise OverflowError(f"more than {MAX_BYTES} bytes come out of {len(data)}")
        if not decoder.eof:
            raise EOFError("the compressed data ends early")
    except OverflowError:
        raise
    except DAMAGE:
        if whole:
            raise
    return b"".join(pieces)


def _steps(decoder: Any, compression: str, view: memoryview) -> Iterator[bytes]:
    if compression == "lz4":
        piece = decoder.decompress(view, max_length=_PIECE)
        while piece or not decoder.needs_input:
            yield piece
            if decoder.eof:
                return
            piece = decoder.decompress(b"", max_length=_PIECE)
        return
    for start in range(0, len(view), _STEP):
        if decoder.eof:
            return
        yield decoder.decompress(view[start : start + _STEP])
