"""Messages out of rosbag2 folders and bare MCAP and sqlite3 files, also damaged ones."""

from __future__ import annotations

import re
import sqlite3
import struct
import sys
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import apsw
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Footer, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.serde import SerdeError

from dyfn_ros.recording_writer import TYPES, RecordingError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

# What the readers are known to raise on bytes that are no longer what was written.
DAMAGE = (
    ReaderError,
    SerdeError,
    McapError,
    zstandard.ZstdError,
    zstd.ZstdError,
    apsw.Error,
    sqlite3.Error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    RuntimeError,
    AssertionError,
)


class Recorded(NamedTuple):
    """One message: log_ns is when it was recorded, data is its CDR bytes."""

    topic: str
    kind: str
    log_ns: int
    data: bytes

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

    topics: name -> Topic.
    """

    topics: dict[str, Topic]

    @property
    def losses(self) -> list[str]:
        """What could not be read, one sentence each; complete after messages() is exhausted."""

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """Messages of these topics in log-time order; equal times in the order of recording."""


class IntactStorage:
    """A folder or file whose index can be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []
        self._reader = Reader(path)  # stays open: opening a folder parses YAML for 0.3 s
        self._reader.open()
        self.topics: dict[str, Topic] = {}
        for connection in self._reader.connections:
            known = self.topics.get(connection.topic, Topic(connection.msgtype, 0))
            count = known.count + connection.msgcount
            self.topics[connection.topic] = Topic(known.kind, count)

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See Storage. Damage on the way ends the iteration and is added to the losses."""
        last = None
        chosen = [c for c in self._reader.connections if c.topic in topics]
        found = self._reader.messages(chosen) if chosen else iter(())
        while True:
            try:
                connection, last, data = next(found)
            except StopIteration:
                return
            except DAMAGE as error:
                when = "from the start" if last is None else f"after log time {last / 1e9:.3f} s"
                self.losses = [f"{self.path}: unreadable {when}: {error}"]
                return
            yield Recorded(connection.topic, connection.msgtype, last, bytes(data))


class LinearMcap:
    """An MCAP without a usable index: read from its start to the first bad record.

    Messages come in log-time order within each chunk, chunks as they were written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []
        counts: Counter[tuple[str, str]] = Counter()
        for recorded in self._scan():
            counts[recorded.topic, recorded.kind] += 1
        self.topics = {topic: Topic(kind, count) for (topic, kind), count in counts.items()}

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See Storage."""
        return (recorded for recorded in self._scan() if recorded.topic in topics)

    def _scan(self) -> Iterator[Recorded]:
        self.losses = []
        size = self.path.stat().st_size
        good = 0
        schemas: dict[int, str] = {}
        channels: dict[int, Channel] = {}
        with self.path.open("rb") as file:
            records = iter(StreamReader(file, emit_chunks=True, record_size_limit=size).records)
            while True:
                try:
                    record = next(records, None)
                    if record is None or isinstance(record, Footer):
                        return
                    yield from _decode(record, schemas, channels)
                except DAMAGE as error:
                    reason = f"{type(error).__name__} {error}".strip()
                    self.losses = [
                        f"{self.path}: read up to byte {good} of {size} ({good / size:.0%}), "
                        f"the rest is damaged or missing ({reason})"
                    ]
                    return
                good = file.tell()


def _decode(
    record: McapRecord, schemas: dict[int, str], channels: dict[int, Channel]
) -> list[Recorded]:
    """Remember schemas and channels; return the messages of a record in log-time order."""
    found = []
    for part in breakup_chunk(record, True) if isinstance(record, Chunk) else [record]:
        if isinstance(part, Schema):
            schemas[part.id] = part.name
        elif isinstance(part, Channel):
            channels[part.id] = part
        elif isinstance(part, Message) and channels[part.channel_id].message_encoding == "cdr":
            channel = channels[part.channel_id]
            kind = schemas.get(channel.schema_id, "")
            found.append(Recorded(channel.topic, kind, part.log_time, part.data))
    return sorted(found, key=lambda recorded: recorded.log_ns)


class LinearSqlite:
    """A sqlite3 recording that cannot be indexed: rows in order up to the first bad page."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []
        counts: Counter[tuple[str, str]] = Counter()
        for recorded in self._scan():
            counts[recorded.topic, recorded.kind] += 1
        self.topics = {topic: Topic(kind, count) for (topic, kind), count in counts.items()}

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See Storage."""
        return (recorded for recorded in self._scan() if recorded.topic in topics)

    def _scan(self) -> Iterator[Recorded]:
        self.losses = []
        count = 0
        uri = f"{self.path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            try:
                # Without this, sqlite refuses a file that is shorter than its header says.
                database.execute("PRAGMA writable_schema = ON")
                rows = database.execute("SELECT id, name, type FROM topics")
                topics = {key: (name, kind) for key, name, kind in rows}
                query = "SELECT topic_id, timestamp, data FROM messages ORDER BY id"
                for key, stamp, data in database.execute(query):
                    count += 1
                    yield Recorded(*topics[key], stamp, data)
            except (sqlite3.Error, LookupError) as error:
                self.losses = [f"{self.path}: {count} messages read, then: {error}"]


class ChainedStorage:
    """Several files of one recording, one after the other."""

    def __init__(self, parts: list[Storage], losses: list[str]) -> None:
        self.parts = parts
        self._lost = losses
        self.topics: dict[str, Topic] = {}
        for part in parts:
            for name, topic in part.topics.items():
                known = self.topics.get(name, Topic(topic.kind, 0))
                self.topics[name] = Topic(known.kind, known.count + topic.count)

    @property
    def losses(self) -> list[str]:
        """See Storage."""
        return [*self._lost, *(loss for part in self.parts for loss in part.losses)]

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See Storage."""
        for part in self.parts:
            yield from part.messages(topics)


LINEAR: dict[str, type[LinearMcap] | type[LinearSqlite]] = {
    ".mcap": LinearMcap,
    ".db3": LinearSqlite,
}


def open_storage(path: str | Path) -> Storage:
    """Open a rosbag2 folder (with or without metadata.yaml) or a bare .mcap or .db3 file.

    Where the index is unreadable, everything up to the damage is used and the loss is reported
    in `losses`. Raises RecordingError when nothing can be read, saying what was expected.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path} does not exist")
    storage: Storage = _open_folder(path) if path.is_dir() else _open_file(path)
    if not any(topic.count for topic in storage.topics.values()):
        reasons = "; ".join(storage.losses) or "it holds no messages"
        raise RecordingError(f"{path}: nothing to read: {reasons}")
    return storage


def _open_folder(path: Path) -> Storage:
    files = sorted((f for f in path.iterdir() if f.suffix in LINEAR), key=_natural)
    reason = ""
    if (path / "metadata.yaml").exists():
        try:
            return IntactStorage(path)
        except DAMAGE as error:
            reason = f": {error}"
    if not files:
        raise RecordingError(
            f"{path}: expected a rosbag2 folder (metadata.yaml and .mcap or .db3 files) "
            f"or an RGB-D folder (rgb/, depth/, K.txt){reason}"
        )
    parts, losses = [], []
    for file in files:
        try:
            parts.append(_open_file(file))
        except RecordingError as error:
            losses.append(str(error))
    if not parts:
        raise RecordingError("; ".join(losses))
    return ChainedStorage(parts, losses)


def _natural(file: Path) -> list[int | str]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", file.name)]


def _open_file(path: Path) -> Storage:
    if path.suffix not in LINEAR:
        raise RecordingError(
            f"{path}: expected a rosbag2 folder, an .mcap or .db3 file, or an RGB-D folder"
        )
    if path.stat().st_size == 0:
        raise RecordingError(f"{path} is empty")
    try:
        return IntactStorage(path)
    except DAMAGE as error:
        linear = LINEAR[path.suffix](path)
        if not linear.topics:
            reasons = "; ".join(linear.losses) or str(error)
            raise RecordingError(f"{path} is not a readable recording: {reasons}") from error
        return linear
