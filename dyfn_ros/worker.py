"""A thread that takes frames one at a time, so that nobody else waits for inference."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class FrameWorker(Generic[T]):
    """Calls `work(frame)` for the submitted frames, in order, in one thread of its own.

    With keep_all False it holds one waiting frame, the latest: a newer one replaces it, and the
    replaced one counts as dropped. With keep_all True it holds up to `capacity` frames and refuses
    (and counts) what comes when they are full.

    prepare: runs first, in the same thread (loading a model). An exception from it, or from
    `work`, ends the thread and goes to `failed`.
    """

    def __init__(
        self,
        work: Callable[[T], None],
        *,
        prepare: Callable[[], None] = lambda: None,
        failed: Callable[[BaseException], None] = lambda error: None,
        keep_all: bool = False,
        capacity: int = 1,
        held: bool = False,
    ) -> None:
        self._work, self._prepare, self._failed = work, prepare, failed
        self._keep_all = keep_all
        self._capacity = capacity if keep_all else 1
        self._held = held
        self._stopping = False
        self._waiting: deque[T] = deque()
        self._dropped = 0
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="inference", daemon=True)

    @property
    def dropped(self) -> int:
        """Frames that were replaced, refused or discarded before they started."""
        with self._changed:
            return self._dropped

    def start(self) -> None:
        self._thread.start()

    def submit(self, frame: T) -> bool:
        """Never waits for the work. -> False when the frame was refused."""
        with self._changed:
            if len(self._waiting) == self._capacity:
                self._dropped += 1
                if self._keep_all:
                    return False
                self._waiting.popleft()
            self._waiting.append(frame)
            self._changed.notify()
            return True

    def release(self) -> None:
        """Let a worker that was made with held=True begin with what waits."""
        with self._changed:
            self._held = False
            self._changed.notify()

    def discard(self) -> int:
        """Drop what waits; the frame being worked on is finished. -> how many were dropped."""
        with self._changed:
            count = len(self._waiting)
            self._waiting.clear()
            self._dropped += count
            return count

    def stop(self, patience: float | None = None) -> bool:
        """Drop what waits and let the frame being worked on finish.

        patience: seconds to wait for that; None waits as long as it takes. -> whether it finished.
        """
        with self._changed:
            self._stopping = True
            self._dropped += len(self._waiting)
            self._waiting.clear()
            self._changed.notify()
        if self._thread.is_alive():
            self._thread.join(patience)
        return not self._thread.is_alive()

    def _next(self) -> T | None:
        with self._changed:
            self._changed.wait_for(lambda: self._stopping or (self._waiting and not self._held))
            return None if self._stopping else self._waiting.popleft()

    def _run(self) -> None:
        try:
            self._prepare()
            while (frame := self._next()) is not None:
                self._work(frame)
        except Exception as error:
            self._failed(error)
