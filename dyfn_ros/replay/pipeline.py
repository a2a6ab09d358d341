"""Work beside the model: frames read ahead of it, results written behind it, in their order."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Generator, Iterable
from types import TracebackType
from typing import Generic, TypeVar

DEPTH = 4  # items that wait between two threads

Item = TypeVar("Item")


def ahead(items: Iterable[Item], depth: int = DEPTH) -> Generator[Item, None, None]:
    """The same items, made in a thread of their own, at most `depth` before they are taken.

    Args:
        items: What to go through, in that thread alone; it is closed there, if it can be.
        depth: Items that wait.

    Yields:
        The items in their order.

    Raises:
        Exception: What `items` raises, after the items before it.
    """
    ready: queue.Queue[tuple[bool, Item | BaseException | None]] = queue.Queue(depth)
    stop = threading.Event()

    def put(last: bool, value: Item | BaseException | None) -> bool:
        """Whether somebody still takes it."""
        while not stop.is_set():
            try:
                ready.put((last, value), timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def work() -> None:
        source = iter(items)
        try:
            if all(put(False, item) for item in source):
                put(True, None)
        except BaseException as error:
            put(True, error)
        finally:
            if hasattr(source, "close"):
                source.close()

    thread = threading.Thread(target=work, name="read ahead", daemon=True)
    thread.start()
    try:
        while True:
            last, value = ready.get()
            if not last:
                yield value  # type: ignore[misc]
            elif isinstance(value, BaseException):
                raise value
            else:
                return
    finally:
        stop.set()
        thread.join()


class Behind(Generic[Item]):
    """Calls a function with items, one after the other, in a thread of its own.

    As a context: the end waits until all items are done. An exception of the function is raised by
    the next `push`, or at the end; no later item is worked on. When the block itself raises, the
    items that wait are dropped.
    """

    def __init__(self, work: Callable[[Item], None], depth: int = DEPTH) -> None:
        """Begin.

        Args:
            work: What is called.
            depth: Items that wait.
        """
        self._work = work
        self._waiting: queue.Queue[Item | None] = queue.Queue(depth)
        self._error: BaseException | None = None
        self._dropped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="write behind", daemon=True)

    def __enter__(self) -> Behind[Item]:
        self._thread.start()
        return self

    def push(self, item: Item) -> None:
        """Hand an item over; waits while too many wait. Raises what the function has raised."""
        self._raise()
        self._waiting.put(item)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._dropped.set()
        self._waiting.put(None)
        self._thread.join()
        if kind is None:
            self._raise()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            self._dropped.set()
            raise error

    def _run(self) -> None:
        while (item := self._waiting.get()) is not None:
            if self._error is not None or self._dropped.is_set():
                continue  # taken all the same, so that push does not wait for ever
            try:
                self._work(item)
            except BaseException as error:
                self._error = error
