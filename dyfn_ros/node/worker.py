"""A thread that takes frames of several cameras, so that nobody else waits for inference."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass
class _Source(Generic[T]):
    held: bool
    waiting: deque[T] = field(default_factory=deque)
    dropped: int = 0


class FrameWorker(Generic[T]):
    """Calls `work(frames)` in one thread of its own, with at most one frame of each source.

    What waits when the thread is free is taken together; no source waits for another's frame.
    With keep_all False each source holds one waiting frame, the latest: a newer one replaces it,
    and the replaced one counts as dropped. With keep_all True it holds up to `capacity` frames,
    in order, and refuses (and counts) what comes when they are full.

    prepare: runs first, in the same thread (loading a model). An exception from it, or from
    `work`, ends the thread and is then `error`. held: per source, whether its frames wait for
    `release`.
    """

    def __init__(
        self,
        work: Callable[[list[T]], None],
        *,
        prepare: Callable[[], None] = lambda: None,
        keep_all: bool = False,
        capacity: int = 1,
        held: Sequence[bool] = (False,),
    ) -> None:
        self._work, self._prepare = work, prepare
        self._keep_all = keep_all
        self._capacity = capacity if keep_all else 1
        self._stopping = False
        self._sources: list[_Source[T]] = [_Source(waits) for waits in held]
        self._changed = threading.Condition()
        self._prepared = False
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="inference", daemon=True)

    def dropped(self, source: int = 0) -> int:
        """Frames of a source that were replaced, refused or discarded before they started."""
        with self._changed:
            return self._sources[source].dropped

    def start(self) -> None:
        self._thread.start()

    def wait_prepared(self, patience: float) -> bool:
        """Whether prepare has ended, well or with `error`, within `patience` seconds."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._prepared or self.error is not None, patience
            )

    def submit(self, frame: T, source: int = 0) -> bool:
        """Never waits for the work. -> False when the frame was refused."""
        with self._changed:
            queue = self._sources[source]
            if len(queue.waiting) == self._capacity:
                queue.dropped += 1
                if self._keep_all:
                    return False
                queue.waiting.popleft()
            queue.waiting.append(frame)
            self._changed.notify_all()
            return True

    def release(self, source: int = 0) -> None:
        """Let a source that was made held begin with what waits."""
        with self._changed:
            self._sources[source].held = False
            self._changed.notify_all()

    def discard(self, source: int = 0) -> int:
        """Drop what waits; the frame being worked on is finished. -> how many were dropped."""
        with self._changed:
            return self._discard(self._sources[source])

    def _discard(self, queue: _Source[T]) -> int:
        count = len(queue.waiting)
        queue.waiting.clear()
        queue.dropped += count
        return count

    def stop(self, patience: float | None = None) -> bool:
        """Drop what waits and let the frames being worked on finish.

        patience: seconds to wait for that; None waits as long as it takes. -> whether it finished.
        """
        with self._changed:
            self._stopping = True
            for queue in self._sources:
                self._discard(queue)
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(patience)
        return not self._thread.is_alive()

    def _next(self) -> list[T]:
        """What waits, one frame of each source; empty when stopping."""

        def ready() -> list[_Source[T]]:
            return [queue for queue in self._sources if queue.waiting and not queue.held]

        with self._changed:
            self._changed.wait_for(lambda: self._stopping or ready())
            return [] if self._stopping else [queue.waiting.popleft() for queue in ready()]

    def _run(self) -> None:
        try:
            self._prepare()
            with self._changed:
                self._prepared = True
                self._changed.notify_all()
            while frames := self._next():
                self._work(frames)
        except Exception as error:
            with self._changed:
                self.error = error
                self._changed.notify_all()
