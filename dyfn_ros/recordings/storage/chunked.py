"""Recordings that are files of chunks: read by their index, or from start to end without one."""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from dyfn_ros.recordings.storage.base import (
    DAMAGE,
    MAX_BYTES,
    Losses,
    Recorded,
    Topic,
    count_topics,
    reason,
)

MAX_OPEN = 16  # chunks that overlap in time and are held at once


class Span(NamedTuple):
    """A chunk: log times of its first and last message, its place in the file.

    channels: those that have messages in it; empty when unknown.
    """

    start_ns: int
    end_ns: int
    offset: int
    length: int
    channels: frozenset[int] = frozenset()


class Index(NamedTuple):
    """What a file's index says. channels: id -> topic; topics: with how many messages."""

    spans: list[Span]
    channels: dict[int, str]
    topics: dict[str, Topic]


class ChunkedFile(ABC):
    """See Storage. Without a usable index, messages come in log-time order within each chunk,
    chunks as they were written.

    Chunks that cannot be read are left out, whatever is behind them is read.
    """

    remarks: Sequence[str] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size
        self._lost = Losses()
        self._index: Index | None = None
        try:
            self._index = self._read_index()
        except DAMAGE:
            self._index = None
        self.topics = self._index.topics if self._index else count_topics(self._scan())
        self._known = self._lost.sentences  # however little of the messages is read later

    @property
    def losses(self) -> list[str]:
        """See Storage."""
        return [*dict.fromkeys([*self._known, *self._lost.sentences])]

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See Storage."""
        self._lost = Losses()
        found = self._indexed(topics) if self._index else self._scan()
        for recorded in found:
            if recorded.topic not in topics:
                continue
            kind = self.topics[recorded.topic].kind
            if recorded.kind != kind:
                self._lost.beside(recorded.topic, recorded.kind, kind)
                continue
            try:
                whole = self._finish(recorded)
            except DAMAGE as error:
                self._lost.add(f"{self.path}: a message of {recorded.topic}: {reason(error)}")
                continue
            yield whole

    def _indexed(self, topics: Collection[str]) -> Iterator[Recorded]:
        assert self._index is not None
        channels = {key for key, topic in self._index.channels.items() if topic in topics}
        spans = [s for s in self._index.spans if not s.channels or s.channels & channels]
        with self.path.open("rb") as file:

            def read(span: Span) -> list[Recorded]:
                try:
                    found = self._read_chunk(file, span)
                    return sorted(found, key=lambda recorded: recorded.log_ns)
                except DAMAGE as error:
                    self._lose(span, error)
                    return []

            yield from merged(spans, read)

    def _lose(self, span: Span, error: BaseException) -> None:
        self._lost.add(
            f"{self.path}: the chunk at byte {span.offset} of {self.size}, log time "
            f"{span.start_ns / 1e9:.3f} to {span.end_ns / 1e9:.3f} s, is damaged and left out "
            f"({reason(error)})"
        )

    def _report(self, start: int, following: int | None, error: str) -> None:
        """Note that the bytes from start on are lost, up to where the reading goes on."""
        if following is None:
            text = (
                f"read up to byte {start} of {self.size} ({start / self.size:.0%}), "
                f"the rest is damaged or missing ({error})"
            )
        else:
            text = f"bytes {start} to {following} of {self.size} are damaged, left out ({error})"
        self._lost.add(f"{self.path}: {text}")

    def _finish(self, recorded: Recorded) -> Recorded:
        """A message that is wanted, in the form that all storages give."""
        if recorded.to_cdr is None:
            return recorded
        return recorded._replace(data=recorded.to_cdr(recorded.data), to_cdr=None)

    @abstractmethod
    def _read_index(self) -> Index | None:
        """None, or one of DAMAGE, when there is no index to be trusted."""

    @abstractmethod
    def _read_chunk(self, file: BinaryIO, span: Span) -> list[Recorded]:
        """All messages of a chunk; raises one of DAMAGE."""

    @abstractmethod
    def _scan(self) -> Iterator[Recorded]:
        """Every message that can be found from start to end; sets losses anew."""


def merged(spans: Sequence[Span], read: Callable[[Span], list[Recorded]]) -> Iterator[Recorded]:
    """Messages of chunks in log-time order, equal times in the order of the file.

    A chunk is read when its time has come. Of chunks that overlap, MAX_OPEN or MAX_BYTES are held
    at once; messages of the others may come late.
    """
    waiting = sorted(spans, key=lambda span: (span.start_ns, span.offset), reverse=True)
    opened: list[_Cursor] = []
    while waiting or opened:
        while waiting and (not opened or _due(waiting[-1], opened)):
            span = waiting.pop()
            messages = read(span)
            if messages:
                size = sum(len(recorded.data) for recorded in messages)
                first = messages[0].log_ns
                heapq.heappush(opened, _Cursor(first, span.offset, 0, messages, size))
        if opened:
            cursor = opened[0]
            yield cursor.messages[cursor.count]
            cursor.count += 1
            if cursor.count == len(cursor.messages):
                heapq.heappop(opened)
            else:
                cursor.log_ns = cursor.messages[cursor.count].log_ns
                heapq.heapreplace(opened, cursor)


@dataclass(order=True)
class _Cursor:
    """The next message of a chunk that is open."""

    log_ns: int
    offset: int
    count: int
    messages: list[Recorded] = field(compare=False)
    size: int = field(compare=False)


def _due(span: Span, opened: list[_Cursor]) -> bool:
    held = sum(cursor.size for cursor in opened)
    return span.start_ns <= opened[0].log_ns and len(opened) < MAX_OPEN and held < MAX_BYTES


def read_exactly(file: BinaryIO, size: int, limit: int) -> bytes:
    """size bytes; ValueError above the limit, EOFError when the file ends before."""
    if size > limit:
        raise ValueError(f"a length of {size} bytes, of which {limit} are there")
    data = file.read(size)
    if len(data) != size:
        raise EOFError(f"{len(data)} of {size} bytes")
    return data
