"""What has come since the last frame that was worked on, thinned out."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, Protocol, TypeVar

_APART = 0.15  # seconds between the arrivals of what is kept
_MOST = 16


class Arrival(Protocol):
    """Something that came at a time."""

    @property
    def arrived(self) -> float:
        """Seconds."""


T = TypeVar("T", bound=Arrival)


class RecentJobs(Generic[T]):
    """The newest arrivals, so that those that are dropped can still be looked at. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: deque[T] = deque(maxlen=_MOST)

    def add(self, job: T) -> None:
        """One more; the one before goes if the second before is near enough."""
        with self._lock:
            if len(self._kept) > 1 and job.arrived - self._kept[-2].arrived < _APART:
                self._kept.pop()
            self._kept.append(job)

    def before(self, job: T) -> list[T]:
        """What is kept of the time before this one, oldest first; forgotten here."""
        found = []
        with self._lock:
            while self._kept and self._kept[0].arrived <= job.arrived:
                found.append(self._kept.popleft())
        return [one for one in found if one is not job]

    def clear(self) -> None:
        """Forget all."""
        with self._lock:
            self._kept.clear()
