"""Which measurement belongs to which frame, when both arrive in their own time."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Sequence
from typing import Generic, TypeVar

T = TypeVar("T")


class Pairing(Generic[T]):
    """Measurements wait here for the frame of their time. Safe for several threads.

    A measurement belongs to the frame of the nearest stamp, among those that are known.

    tolerance: seconds between a measurement and a frame that still belong together.
    capacity: measurements that may wait; beyond it the oldest is dropped.
    dropped: by reason: "stale" (older than the frame by more than the tolerance), "future-dated"
    (ahead of the frame by more than `ahead` seconds), "overrun" (too many waiting).
    """

    def __init__(self, tolerance: float = 0.1, capacity: int = 50, ahead: float = 2.0) -> None:
        if tolerance <= 0 or capacity < 1:
            raise ValueError(f"tolerance {tolerance} and capacity {capacity} must be positive")
        self.tolerance, self.capacity, self.ahead = tolerance, capacity, ahead
        self.dropped: Counter[str] = Counter()
        self.last_stamp: float | None = None
        self._waiting: deque[tuple[float, T]] = deque()
        self._lock = threading.Lock()

    def put(self, stamp: float, measurement: T) -> None:
        """stamp: seconds, of the measurement."""
        with self._lock:
            self.last_stamp = stamp
            if len(self._waiting) == self.capacity:
                self._waiting.popleft()
                self.dropped["overrun"] += 1
            self._waiting.append((stamp, measurement))

    def take(self, stamp: float, earlier: Sequence[float] = ()) -> list[tuple[float, T]]:
        """The measurements that belong to known frames; each is given out once.

        stamp: of the present frame. earlier: of frames before it that a measurement may still be
        of. Returns pairs of the frame's stamp and the measurement, in the order of the stamps.
        """
        taken: list[tuple[float, T]] = []
        with self._lock:
            waiting, self._waiting = self._waiting, deque()
            for when, measurement in waiting:
                nearest = min((stamp, *earlier), key=lambda known: abs(known - when))
                if abs(nearest - when) <= self.tolerance:
                    taken.append((nearest, measurement))
                elif when < stamp:
                    self.dropped["stale"] += 1
                elif when > stamp + self.ahead:
                    self.dropped["future-dated"] += 1
                else:
                    self._waiting.append((when, measurement))
        return sorted(taken, key=lambda pair: pair[0])

    def clear(self) -> None:
        """Forget what waits (a stream that was reset, with another clock)."""
        with self._lock:
            self._waiting.clear()
            self.last_stamp = None
