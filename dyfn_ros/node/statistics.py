"""Counts, rates and latencies of one camera's frames."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

WINDOW = 1000  # frames that the latency quantiles are of
PLAUSIBLE = 3600.0  # seconds; a latency beyond says that stamps are of another clock


@dataclass(frozen=True)
class StatisticsSnapshot:
    """The numbers of one moment.

    counts: since the start: received, published, bad (not usable), failed (inference raised),
        skipped (by max_rate), damaged (worked on all the same), unpublished (the shutdown came
        first), inactive (came while the node was not active), lost (sent, and never here).
    input_rate, output_rate: frames a second since the snapshot before.
    latency: p50 and p99 in seconds from input stamp to publishing, None before the first frame.
    same_clock: whether these latencies are plausible at all.
    processing: p50 and p99 in seconds from the image's arrival to publishing.
    recent: what the counts have grown by since the snapshot before.
    """

    counts: dict[str, int]
    recent: dict[str, int]
    input_rate: float
    output_rate: float
    latency: tuple[float, float] | None
    same_clock: bool
    processing: tuple[float, float] | None


class FrameStatistics:
    """For several threads at once."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._latency: deque[float] = deque(maxlen=WINDOW)
        self._processing: deque[float] = deque(maxlen=WINDOW)
        self._before: Counter[str] = Counter()
        self._at = clock()
        self.valid_ratio: float | None = None  # share of valid pixels of the last frame published

    def count(self, what: str, number: int = 1) -> None:
        """So many more of these; see StatisticsSnapshot.counts."""
        with self._lock:
            self._counts[what] += number

    def published(self, latency: float, processing: float) -> None:
        """A frame is done; seconds from its stamp, and from its arrival."""
        with self._lock:
            self._counts["published"] += 1
            self._latency.append(latency)
            self._processing.append(processing)

    @property
    def counts(self) -> Counter[str]:
        """Since the start."""
        with self._lock:
            return Counter(self._counts)

    def snapshot(self) -> StatisticsSnapshot:
        """The numbers now; rates are of the time since the last call."""
        with self._lock:
            now, counts = self._clock(), Counter(self._counts)
            seconds = max(now - self._at, 1e-9)
            recent = counts - self._before
            latency, processing = list(self._latency), list(self._processing)
            self._at, self._before = now, counts
        quantiles = _quantiles(latency)
        return StatisticsSnapshot(
            counts=dict(counts),
            recent=dict(recent),
            input_rate=recent["received"] / seconds,
            output_rate=recent["published"] / seconds,
            latency=quantiles,
            same_clock=quantiles is None or -PLAUSIBLE < quantiles[0] < PLAUSIBLE,
            processing=_quantiles(processing),
        )


def _quantiles(values: list[float]) -> tuple[float, float] | None:
    if not values:
        return None
    median, most = np.quantile(values, [0.5, 0.99])
    return float(median), float(most)
