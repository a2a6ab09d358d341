"""Messages out of an MCAP file, also one without index or with damage in it."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from io import BytesIO
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    Footer,
    McapRecord,
    Schema,
    Statistics,
)

from dyfn_ros.recordings.storage.base import (
    DAMAGE,
    MAX_BYTES,
    Losses,
    Recorded,
    decompress,
    reason,
    topics_of,
)
from dyfn_ros.recordings.storage.chunked import ChunkedFile, Index, Span, read_exactly
from dyfn_ros.recordings.storage.forms import Form, message_form

MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # opcode and length of a record
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log and publish time; then the data
_FOOTER = 20
_END = _HEAD.size + _FOOTER + len(MAGIC)
_OPCODES = {int(opcode) for opcode in Opcode}
_PRIVATE = 0x80  # opcodes from here on are others' own
# The start of a chunk: its length, times, size, checksum, compression.
_CHUNK = rb"\x06.{5}\x00{3}.{28}(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4})"
_PARSERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.CHUNK_INDEX: ChunkIndex.read,
    Opcode.STATISTICS: Statistics.read,
    Opcode.FOOTER: Footer.read,
}


class McapFile(ChunkedFile):
    """See ChunkedFile. The index is the summary section, if it is whole and fits the file."""

    _expected: int | None = None  # messages, as the summary says
    _schemas: dict[int, Schema]
    _channels: dict[int, Channel]
    _forms: dict[int, Form]  # of channels
    _chunked: bool

    def _read_index(self) -> Index | None:
        summary = list(self._summary())
        self._schemas = {r.id: r for r in summary if isinstance(r, Schema)}
        self._forms = {}
        channels = {r.id: r for r in summary if isinstance(r, Channel)}
        statistics = [r for r in summary if isinstance(r, Statistics)]
        chunks = [r for r in summary if isinstance(r, ChunkIndex)]
        if not statistics or not channels or not chunks:
            return None
        self._expected = statistics[0].message_count
        schemas = {channel.schema_id for channel in channels.values() if channel.schema_id}
        if len(chunks) != statistics[0].chunk_count or not schemas <= set(self._schemas):
            return None
        counts = statistics[0].channel_message_counts
        topics = topics_of(
            (channel.topic, self._form(channel).kind, counts.get(key, 0))
            for key, channel in channels.items()
        )
        spans = self._spans(chunks)
        if spans is None:
            return None
        self._channels = channels
        return Index(spans, {k: c.topic for k, c in channels.items()}, topics)

    def _summary(self) -> Iterator[McapRecord]:
        with self.path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC or self.size < _END:
                return
            file.seek(-_END, 2)
            end = file.read(_END)
            start, _, crc = struct.unpack("<QQI", end[_HEAD.size : -len(MAGIC)])
            length = self.size - _END - start
            intact = end.startswith(_HEAD.pack(Opcode.FOOTER, _FOOTER)) and end.endswith(MAGIC)
            if not intact or start == 0 or not 0 < length <= MAX_BYTES:
                return
            file.seek(start)
            section = read_exactly(file, length, length)
        if crc and zlib.crc32(end[: -len(MAGIC) - 4], zlib.crc32(section)) != crc:
            return
        for opcode, content in split_records(section):
            record = parse(opcode, content)
            if record is not None:
                yield record

    def _spans(self, chunks: list[ChunkIndex]) -> list[Span] | None:
        """None when one of the chunks does not begin where it should."""
        spans = []
        with self.path.open("rb") as file:
            for chunk in chunks:
                file.seek(chunk.chunk_start_offset)
                head = _HEAD.pack(Opcode.CHUNK, chunk.chunk_length - _HEAD.size)
                end = chunk.chunk_start_offset + chunk.chunk_length
                if file.read(_HEAD.size) != head or end > self.size:
                    return None
                spans.append(
                    Span(
                        chunk.message_start_time,
                        chunk.message_end_time,
                        chunk.chunk_start_offset,
                        chunk.chunk_length,
                        frozenset(chunk.message_index_offsets),
                    )
                )
        return spans

    def _read_chunk(self, file: BinaryIO, span: Span) -> list[Recorded]:
        file.seek(span.offset + _HEAD.size)
        content = read_exactly(file, span.length - _HEAD.size, MAX_BYTES)
        return list(self._messages(split_records(unpack_chunk(content))))

    def _messages(self, records: Iterator[tuple[int, bytes]]) -> Iterator[Recorded]:
        """Messages; schemas and channels are remembered. Raises one of DAMAGE."""
        for opcode, content in records:
            if opcode == Opcode.MESSAGE:
                key, _, log_ns, _ = _MESSAGE.unpack_from(content)
                channel = self._channels[key]
                form = self._form(channel)
                data = content[_MESSAGE.size :]
                yield Recorded(channel.topic, form.kind, log_ns, data, form.to_cdr)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                record: Any = parse(opcode, content)
                if opcode == Opcode.SCHEMA:
                    self._schemas[record.id] = record
                else:
                    if self._channels.get(record.id, record) != record:
                        self._forms.pop(record.id, None)
                    self._channels[record.id] = record

    def _form(self, channel: Channel) -> Form:
        """How its messages are read."""
        form = self._forms.get(channel.id)
        if form is None:
            schema = self._schemas.get(channel.schema_id)
            form = message_form(channel.message_encoding, schema)
            if schema is not None:
                self._forms[channel.id] = form
        return form

    def _scan(self) -> Iterator[Recorded]:
        self._lost = Losses()
        self._schemas, self._channels, self._forms = {}, {}, {}
        self._chunked = False
        count = 0
        with (
            self.path.open("rb") as file,
            closing(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)) as view,
        ):
            for recorded in self._walk(view):
                count += 1
                yield recorded
        if not self._lost.sentences and self._expected is not None and count < self._expected:
            missing = self._expected - count
            self._lost.add(f"{self.path}: {missing} of {self._expected} messages not found")

    def _walk(self, view: mmap.mmap) -> Iterator[Recorded]:
        """From record to record; behind damage, from the next thing that looks like one."""
        position = len(MAGIC) if view[: len(MAGIC)] == MAGIC else 0
        finished = False
        while position < self.size and not finished:
            end, error = position + _HEAD.size, "it ends early"
            found: list[Recorded] = []
            try:
                opcode, length = _HEAD.unpack(view[position:end])
                found, end, finished = self._take(view, opcode, position, length)
                position = end
            except DAMAGE as caught:
                error = reason(caught)
                following = self._resume(view, position)
                self._report(position, following, error)
                found = self._salvage(view, position) if following is None else []
                position = self.size if following is None else following
                finished = following is None
            yield from found
        if not finished and not self._lost.sentences:
            self._report(position, None, "it has no end")

    def _take(
        self, view: mmap.mmap, opcode: int, position: int, length: int
    ) -> tuple[list[Recorded], int, bool]:
        """Messages of the record, where it ends, whether the file does."""
        start = position + _HEAD.size
        end = start + length
        if opcode not in _OPCODES and opcode < _PRIVATE:
            raise ValueError(f"no record of type {opcode:#x} is known")
        if end > self.size:
            raise EOFError(f"a record of {length} bytes, of which {self.size - start} are there")
        if opcode == Opcode.DATA_END:
            following = self._resume(view, end)  # none: what follows is the summary, not messages
            if following is None:
                return [], end, True
            raise ValueError("messages behind the end of the data")
        if opcode == Opcode.FOOTER and end != self.size - len(MAGIC):
            raise ValueError("an end record in the middle")
        if opcode not in (Opcode.CHUNK, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
            return [], end, opcode == Opcode.FOOTER
        if length > MAX_BYTES:
            raise ValueError(f"a record of {length} bytes")
        content = view[start:end]
        self._chunked |= opcode == Opcode.CHUNK
        if opcode == Opcode.MESSAGE and end < self.size and view[end] not in _OPCODES:
            raise ValueError("no record follows")  # without checksum, the only sign of damage
        if opcode != Opcode.CHUNK:
            return list(self._messages(iter([(opcode, content)]))), end, False
        try:
            found = list(self._messages(split_records(unpack_chunk(content))))
        except DAMAGE as error:
            if self._starts(view, end):  # the frame holds: only this chunk is bad
                self._report(position, end, reason(error))
                return [], end, False
            raise
        return sorted(found, key=lambda recorded: recorded.log_ns), end, False

    def _starts(self, view: mmap.mmap, position: int) -> bool:
        """Whether a record seems to start here, or the file ends."""
        if position == self.size:
            return True
        head = view[position : position + _HEAD.size]
        if len(head) < _HEAD.size:
            return False
        opcode, length = _HEAD.unpack(head)
        return opcode in _OPCODES and position + _HEAD.size + length <= self.size

    def _resume(self, view: mmap.mmap, position: int) -> int | None:
        """Where the next chunk starts behind a position; in a file without chunks, the next
        message of a known channel."""
        pattern = _CHUNK
        if self._channels and not self._chunked:
            keys = b"|".join(re.escape(struct.pack("<H", key)) for key in self._channels)
            pattern += rb"|\x05.{5}\x00{3}(?:" + keys + rb")"
        search = re.compile(pattern, re.DOTALL).search
        found = search(view, position + 1)
        while found is not None:
            if self._plausible(view, found.start()):
                return found.start()
            found = search(view, found.start() + 1)
        return None

    def _plausible(self, view: mmap.mmap, position: int) -> bool:
        opcode, length = _HEAD.unpack(view[position : position + _HEAD.size])
        end = position + _HEAD.size + length
        if length > MAX_BYTES or end > self.size:
            return False
        if opcode == Opcode.MESSAGE:
            return length > 22 and self._starts(view, end)
        start = position + _HEAD.size + 28
        (name,) = struct.unpack("<I", view[start : start + 4])
        start += 4 + name
        (data,) = struct.unpack("<Q", view[start : start + 8])
        result: bool = int(data) == length - 40 - name
        return result

    def _salvage(self, view: mmap.mmap, position: int) -> list[Recorded]:
        """The first messages of a last chunk that is cut off."""
        found: list[Recorded] = []
        if view[position] != Opcode.CHUNK:
            return found
        content = view[position + _HEAD.size : min(self.size, position + MAX_BYTES)]
        try:
            data = unpack_chunk(content, whole=False)
            for recorded in self._messages(split_records(data)):
                found.append(recorded)
        except DAMAGE:
            pass  # reported already
        return sorted(found, key=lambda recorded: recorded.log_ns)


def split_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record; EOFError when the last one is cut off."""
    position = 0
    while position < len(data):
        opcode, length = _HEAD.unpack_from(data, position)
        position += _HEAD.size
        if position + length > len(data):
            raise EOFError(f"a record of {length} bytes, of which {len(data) - position} are there")
        yield opcode, data[position : position + length]
        position += length


def parse(opcode: int, content: bytes) -> McapRecord | None:
    """A record of the kinds that matter here, else None."""
    parser = _PARSERS.get(opcode)
    return None if parser is None else parser(ReadDataStream(BytesIO(content)))


def unpack_chunk(content: bytes, *, whole: bool = True) -> bytes:
    """The records of a chunk record's content; checks size and checksum when it must be whole."""
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    chunk = replace(chunk, data=decompress(chunk.compression, chunk.data, whole=whole))
    if whole and len(chunk.data) != chunk.uncompressed_size:
        raise ValueError(f"{len(chunk.data)} bytes where {chunk.uncompressed_size} should be")
    if whole and chunk.uncompressed_crc and zlib.crc32(chunk.data) != chunk.uncompressed_crc:
        raise ValueError("wrong checksum")
    result: bytes = chunk.data
    return result
