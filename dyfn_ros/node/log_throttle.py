"""Log lines that repeat at most so often, each text on its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

_LONGEST = 600  # characters of a line


class Throttle:
    """Passes each distinct text on at most once per period, and says what it kept back.

    limit: distinct texts per period; the flood beyond it is counted only. (A text that holds a
    changing number would otherwise pass every time.)
    """

    def __init__(
        self, period: float = 5.0, limit: int = 20, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._period, self._limit, self._clock = period, limit, clock
        self._last: dict[str, float] = {}
        self._kept_back: dict[str, int] = {}
        self._lock = threading.Lock()

    def __call__(self, text: str) -> str:
        """What to log now: the text, with what was kept back before it; or "" for nothing.

        (rclpy identifies a log call by its line of code, so the logging is left to the caller.)
        """
        if len(text) > _LONGEST:
            text = f"{text[:_LONGEST]}... ({len(text)} characters)"
        with self._lock:
            now = self._clock()
            self._last = {t: at for t, at in self._last.items() if now - at < self._period}
            if text in self._last or len(self._last) >= self._limit:
                key = text if text in self._last else ""
                self._kept_back[key] = self._kept_back.get(key, 0) + 1
                return ""
            self._last[text] = now
            again = self._kept_back.pop(text, 0)
            others = self._kept_back.pop("", 0)
            self._kept_back = {t: n for t, n in self._kept_back.items() if t in self._last}
        more = [f"{again} more of these before"] if again else []
        more += [f"{others} other messages not shown"] if others else []
        return f"{text} ({'; '.join(more)})" if more else text
