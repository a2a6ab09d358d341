"""How often something may happen."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable

_EARLY = 0.1  # share of a period that a frame may come before it is due


class Pace:
    """Thins out a camera's images to a rate, evenly over time. One thread."""

    def __init__(self) -> None:
        self._due = 0.0
        self._last: float | None = None  # stamp that was taken
        self._taken = 0.0  # when that was, in seconds of the arrivals' clock

    def takes(self, rate: float, stamp: float, arrived: float) -> bool:
        """Whether an image is to be worked on.

        rate: images a second; 0 is no limit. stamp: seconds. arrived: seconds of another clock,
        which decides where stamps do not go on.
        """
        period = 1 / rate if rate else 0.0
        if self._last is None or stamp < self._last or not period:
            self._due = stamp
        elif stamp == self._last:
            if arrived - self._taken < period:
                return False
        elif stamp < self._due - _EARLY * period:
            return False
        late = stamp - self._due
        self._due = (stamp if late >= period else self._due) + period
        self._last, self._taken = stamp, arrived
        return True


class Chatter:
    """Notices who asks for something again and again. Any thread."""

    def __init__(
        self, most: int, seconds: float = 1.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """most: times in so many seconds that are nobody's business."""
        self._most, self._seconds, self._clock = most, seconds, clock
        self._times: deque[float] = deque(maxlen=most)
        self._lock = threading.Lock()

    def __call__(self) -> bool:
        """It happens now. -> whether that is too often."""
        with self._lock:
            now = self._clock()
            often = len(self._times) == self._most and now - self._times[0] < self._seconds
            self._times.append(now)
            return often
