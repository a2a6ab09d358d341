"""Messages out of a ROS 1 bag (format 2.0), as ROS 2 would have recorded them."""

from __future__ import annotations

import bz2
import mmap
import re
import struct
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from io import BytesIO
from typing import BinaryIO

from rosbags.rosbag1.reader import Header, RecordType, normalize
from rosbags.typesys.msg import normalize_msgtype

from dyfn_ros.recordings.storage.base import (
    DAMAGE,
    MAX_BYTES,
    Losses,
    Recorded,
    Topic,
    decompress,
    reason,
    topics_of,
)
from dyfn_ros.recordings.storage.chunked import ChunkedFile, Index, Span, read_exactly
from dyfn_ros.recordings.storage.forms import Form, ros1_form

MAGIC = b"#ROSBAG V2.0\n"
MAX_HEADER = 1 << 20  # a connection's header holds its message definition
_CHUNK_FIELD = re.compile(rb"\x04\x00{3}op=\x05")
_LONGEST_CHUNK_HEADER = 128  # bytes


class Bag1File(ChunkedFile):
    """See ChunkedFile. Messages have their ROS 2 type and CDR bytes; seq of headers is dropped."""

    def _read_index(self) -> Index | None:
        self._connections: dict[int, tuple[str, Form]] = {}
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                return None
            header, _ = self._record(file)
            if header.get_uint8("op") != RecordType.BAGHEADER or "encryptor" in header:
                return None
            position, count = header.get_uint64("index_pos"), header.get_uint32("chunk_count")
            if not 0 < position < self.size:
                return None
            file.seek(position)
            spans: list[Span] = []
            counts: Counter[int] = Counter()
            while file.tell() < self.size:
                header, data = self._record(file)
                if header.get_uint8("op") == RecordType.CONNECTION:
                    self._connect(header, data)
                else:
                    span, of_chunk = _chunk_info(header, data)
                    spans.append(span)
                    counts.update(of_chunk)
            starts = all(self._chunk_at(file, span.offset) for span in spans)
        if len(spans) != count or not starts:
            return None
        return Index(spans, {k: t for k, (t, _) in self._connections.items()}, self._topics(counts))

    def _topics(self, counts: Counter[int]) -> dict[str, Topic]:
        return topics_of(
            (topic, form.kind, counts[key]) for key, (topic, form) in self._connections.items()
        )

    def _record(self, file: BinaryIO) -> tuple[Header, bytes]:
        """Header and data at the file's position; raises one of DAMAGE."""
        header = read_header(file, self.size - file.tell())
        (length,) = struct.unpack("<I", file.read(4))
        return header, read_exactly(file, length, min(MAX_BYTES, self.size - file.tell()))

    def _chunk_at(self, file: BinaryIO, offset: int) -> bool:
        file.seek(offset)
        try:
            return read_header(file, self.size).get_uint8("op") == RecordType.CHUNK
        except DAMAGE:
            return False

    def _read_chunk(self, file: BinaryIO, span: Span) -> list[Recorded]:
        file.seek(span.offset)
        header, data = self._record(file)
        return list(self._messages(unpack_chunk(header, data)))

    def _connect(self, header: Header, data: bytes) -> None:
        inner = read_header(BytesIO(struct.pack("<I", len(data)) + data), MAX_HEADER)
        topic = normalize(header.get_string("topic"))
        kind = normalize_msgtype(inner.get_string("type"))
        self._connections[header.get_uint32("conn")] = (topic, ros1_form(kind))

    def _messages(self, data: bytes) -> Iterator[Recorded]:
        """Messages of a chunk's data; connections are remembered. Raises one of DAMAGE."""
        file = BytesIO(data)
        while file.tell() < len(data):
            header = read_header(file, len(data))
            (length,) = struct.unpack("<I", file.read(4))
            content = read_exactly(file, length, len(data))
            op = header.get_uint8("op")
            if op == RecordType.CONNECTION:
                self._connect(header, content)
            elif op == RecordType.MSGDATA:
                topic, form = self._connections[header.get_uint32("conn")]
                yield Recorded(topic, form.kind, header.get_time("time"), content, form.to_cdr)

    def _scan(self) -> Iterator[Recorded]:
        self._lost = Losses()
        self._closed = False
        with (
            self.path.open("rb") as file,
            closing(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)) as view,
        ):
            position: int | None = len(MAGIC) if view[: len(MAGIC)] == MAGIC else 0
            while position is not None and position < self.size:
                file.seek(position)
                found: list[Recorded] = []
                try:
                    found, position = self._take(file)
                except DAMAGE as error:
                    following = self._resume(view, position + 1)
                    self._report(position, following, reason(error))
                    if following is None:
                        found = self._salvage(file, position)
                    position = following
                yield from found
        if not self._closed and not self._lost.sentences:
            self._report(self.size, None, "it was not closed")

    def _take(self, file: BinaryIO) -> tuple[list[Recorded], int]:
        header, data = self._record(file)
        end = file.tell()
        op = header.get_uint8("op")
        if op == RecordType.CONNECTION:
            self._connect(header, data)
        elif op == RecordType.CHUNK:
            found = list(self._messages(unpack_chunk(header, data)))
            return sorted(found, key=lambda recorded: recorded.log_ns), end
        elif op not in set(RecordType):
            raise ValueError(f"no record of type {op} is known")
        self._closed |= op == RecordType.CHUNK_INFO
        return [], end

    def _resume(self, view: mmap.mmap, position: int) -> int | None:
        """Where the next chunk starts."""
        found = _CHUNK_FIELD.search(view, position)
        while found is not None:
            earliest = max(position, found.start() - _LONGEST_CHUNK_HEADER)
            for start in range(found.start() - 4, earliest - 1, -1):
                (length,) = struct.unpack("<I", view[start : start + 4])
                if found.end() <= start + 4 + length <= start + _LONGEST_CHUNK_HEADER:
                    return start
            found = _CHUNK_FIELD.search(view, found.end())
        return None

    def _salvage(self, file: BinaryIO, position: int) -> list[Recorded]:
        """The first messages of a last chunk that is cut off."""
        found: list[Recorded] = []
        file.seek(position)
        try:
            header = read_header(file, self.size - position)
            file.seek(4, 1)
            data = file.read(min(MAX_BYTES, self.size - file.tell()))
            for recorded in self._messages(unpack_chunk(header, data, whole=False)):
                found.append(recorded)
        except DAMAGE:
            pass  # reported already
        return sorted(found, key=lambda recorded: recorded.log_ns)


def read_header(file: BinaryIO, limit: int) -> Header:
    """A record's header; raises one of DAMAGE."""
    (length,) = struct.unpack("<I", file.read(4))
    content = read_exactly(file, length, min(limit, MAX_HEADER))
    return Header.read(BytesIO(struct.pack("<I", length) + content))


def _chunk_info(header: Header, data: bytes) -> tuple[Span, dict[int, int]]:
    if header.get_uint8("op") != RecordType.CHUNK_INFO:
        raise ValueError("expected a chunk info in the index")
    counts = dict(struct.iter_unpack("<II", data))
    start, end = header.get_time("start_time"), header.get_time("end_time")
    span = Span(start, end, header.get_uint64("chunk_pos"), 0, frozenset(counts))
    return span, counts


def unpack_chunk(header: Header, data: bytes, *, whole: bool = True) -> bytes:
    """The records of a chunk; checks their size when it must be whole."""
    if header.get_uint8("op") != RecordType.CHUNK:
        raise ValueError("expected a chunk")
    compression = header.get_string("compression")
    if compression == "bz2":
        unpacked = bz2.BZ2Decompressor().decompress(data, MAX_BYTES)
    else:
        names = {"none": "", "lz4": "lz4"}
        unpacked = decompress(names[compression], data, whole=whole)
    if whole and len(unpacked) != header.get_uint32("size"):
        raise ValueError(f"{len(unpacked)} bytes where {header.get_uint32('size')} should be")
    return unpacked
