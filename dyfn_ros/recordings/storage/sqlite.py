"""Messages out of rosbag2's sqlite3 files, also damaged ones."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from dyfn_ros.recordings.storage.base import (
    DAMAGE,
    Losses,
    Recorded,
    Topic,
    count_topics,
    reason,
    topics_of,
)
from dyfn_ros.recordings.storage.forms import Form, ros2_form

_LAST = (1 << 63) - 1


class SqliteFile:
    """See Storage. When a page is bad on the way, the rest comes in the order of recording."""

    remarks: Sequence[str] = ()

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lost = Losses()
        try:
            self.topics = self._count()
        except DAMAGE:
            self.topics = count_topics(r for _, r in self._salvage((-_LAST, -_LAST), None))
        self._known = self._lost.sentences  # however little of the messages is read later

    @property
    def losses(self) -> list[str]:
        """See Storage."""
        return [*dict.fromkeys([*self._known, *self._lost.sentences])]

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See Storage."""
        self._lost = Losses()
        last = (-_LAST, -_LAST)  # log time and row of the last message that was given
        try:
            for row, recorded in self._sorted(topics):
                last = (recorded.log_ns, row)
                yield from self._finished(recorded)
        except DAMAGE:
            for _, recorded in self._salvage(last, topics):
                yield from self._finished(recorded)

    def _finished(self, recorded: Recorded) -> Iterator[Recorded]:
        kind = self.topics[recorded.topic].kind
        if recorded.kind != kind:
            self._lost.beside(recorded.topic, recorded.kind, kind)
            return
        assert recorded.to_cdr is not None
        try:
            found = recorded._replace(data=recorded.to_cdr(recorded.data), to_cdr=None)
        except DAMAGE as error:
            self._lost.add(f"{self.path}: a message of {recorded.topic}: {reason(error)}")
            return
        yield found

    def _count(self) -> dict[str, Topic]:
        with closing(self._open()) as database:
            topics = _topics(database)
            counts = dict(
                database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id")
            )
        if not set(counts) <= set(topics):
            raise LookupError("messages of unknown topics")
        return topics_of(
            (name, form.kind, int(counts.get(key, 0))) for key, (name, form) in topics.items()
        )

    def _open(self) -> sqlite3.Connection:
        """Read only. A write-ahead log beside the file is used when it can be."""
        address = self.path.absolute().as_uri()
        log = Path(f"{self.path}-wal")
        for options in ("mode=ro", "mode=ro&immutable=1"):
            if options == "mode=ro" and not (log.exists() and log.stat().st_size):
                continue
            database = sqlite3.connect(f"{address}?{options}", uri=True)
            try:
                # Without this, sqlite refuses a file that is shorter than its header says.
                database.execute("PRAGMA writable_schema = ON")
                if options == "mode=ro":
                    database.execute("SELECT count(*) FROM topics").fetchone()
                return database
            except DAMAGE:
                database.close()
        raise sqlite3.DatabaseError("not a database")

    def _sorted(self, topics: Collection[str]) -> Iterator[tuple[int, Recorded]]:
        with closing(self._open()) as database:
            known = _topics(database)
            keys = [key for key, (name, _) in known.items() if name in topics]
            marks = ",".join("?" * len(keys))
            query = (
                "SELECT id, topic_id, timestamp, data FROM messages "
                f"WHERE topic_id IN ({marks}) ORDER BY timestamp, id"
            )
            for row in database.execute(query, keys):
                yield int(row[0]), _recorded(known, *row[1:])

    def _salvage(
        self, last: tuple[int, int], topics: Collection[str] | None
    ) -> Iterator[tuple[int, Recorded]]:
        """Rows behind `last` in the order of recording, past pages that cannot be read."""
        count, row = 0, -_LAST
        try:
            with closing(self._open()) as database:
                known = _topics(database)
                start: int | None = row
                while start is not None:
                    try:
                        for row, recorded in _rows(database, known, start):
                            count += 1
                            chosen = topics is None or recorded.topic in topics
                            if chosen and (recorded.log_ns, row) > last:
                                yield row, recorded
                        return
                    except DAMAGE as error:
                        start = _behind(database, known, max(row, start))
                        if start is None:
                            raise
                        self._lost.add(
                            f"{self.path}: rows up to {start - 1} are damaged after {count} "
                            f"messages, left out ({reason(error)})"
                        )
        except DAMAGE as error:
            self._lost.add(f"{self.path}: {count} messages read, then: {reason(error)}")


_Known = dict[int, tuple[str, Form]]  # topics by their keys


def _topics(database: sqlite3.Connection) -> _Known:
    found = {}
    for key, name, kind in database.execute("SELECT id, name, type FROM topics"):
        if not (isinstance(name, str) and isinstance(kind, str)):
            raise TypeError(f"topic {key} has no name or type")
        found[int(key)] = (name, ros2_form(kind))
    return found


def _rows(
    database: sqlite3.Connection, known: _Known, start: int
) -> Iterator[tuple[int, Recorded]]:
    query = "SELECT id, topic_id, timestamp, data FROM messages WHERE id >= ? ORDER BY id"
    previous = start - 1
    for row in database.execute(query, (start,)):
        if int(row[0]) <= previous:
            raise ValueError("rows out of order")
        previous = int(row[0])
        yield previous, _recorded(known, *row[1:])


def _recorded(known: _Known, topic: Any, stamp: Any, data: Any) -> Recorded:
    if not (isinstance(stamp, int) and isinstance(data, bytes)):
        raise TypeError("a row that is no message")
    name, form = known[topic]
    return Recorded(name, form.kind, stamp, data, form.to_cdr)


def _behind(database: sqlite3.Connection, known: _Known, bad: int) -> int | None:
    """The first row behind a bad one from which on rows can be read; None when there is none."""

    def readable(start: int) -> bool:
        try:
            return next(_rows(database, known, start), None) is not None
        except DAMAGE:
            return False

    first = max(bad, 0) + 1
    step = 1
    while not readable(first + step - 1):
        step *= 2
        if first + step > _LAST or step > 1 << 40:
            return None
    low, high = first + step // 2 - 1, first + step - 1
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if readable(middle) else (middle, high)
    return high
