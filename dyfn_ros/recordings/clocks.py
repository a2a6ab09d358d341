"""Whether the stamps of two topics are of one clock, judged by when they were recorded."""

from __future__ import annotations

import math
from array import array
from dataclasses import dataclass

import numpy as np

MIN_PAIRS = 3  # of messages that were recorded together, to say anything
AGREEING = 4  # times as far apart: stamps that do not belong together
NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class ClockOffset:
    """Stamps of one topic less those of another's messages of the same moment.

    Attributes:
        seconds: The median.
        start: Of the first quarter of the recording.
        end: Of the last quarter.
        drifts: Whether start and end differ by more than a constant offset explains.
    """

    seconds: float
    start: float
    end: float
    drifts: bool


class StampedTimes:
    """Stamps of a topic's messages and the times at which they were recorded; 16 bytes each."""

    def __init__(self) -> None:
        """None yet."""
        self._stamps, self._logs = array("q"), array("q")

    def add(self, stamp_ns: int, log_ns: int) -> None:
        """One message, in the order of recording."""
        self._stamps.append(stamp_ns)
        self._logs.append(log_ns)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps(self) -> np.ndarray:
        """(N,) int64 nanoseconds."""
        return np.array(self._stamps, np.int64)

    @property
    def logs(self) -> np.ndarray:
        """(N,) int64 nanoseconds."""
        return np.array(self._logs, np.int64)


def clock_offset(
    images: StampedTimes, others: StampedTimes, least_ns: int, apart: bool
) -> ClockOffset | None:
    """How far the stamps of `others` are after those of images that were recorded with them.

    A topic that is recorded later than another, since it takes longer to compute, looks like one
    of another clock. The stamps themselves tell them apart where they are not quite regular: if
    they agree without an offset, and with one they do not, there is none.

    Args:
        images: Of the image topic.
        others: Of the other topic.
        least_ns: Smaller offsets do not matter.
        apart: Whether most stamps do not agree as they are, so that less than half a period does.

    Returns:
        None when there is none of more than half the longer period, or nothing tells.
    """
    rare, often = (others, images) if len(others) <= len(images) else (images, others)
    if len(rare) < MIN_PAIRS or not _rises(rare.logs) or not _rises(often.logs):
        return None
    sign = 1 if rare is others else -1
    near = _nearest(often.logs, rare.logs)
    if np.median(np.abs(often.logs[near] - rare.logs)) > _period(rare.logs):
        return None  # one topic was written after the other: nothing is recorded together
    together = often.stamps[near]
    differences = sign * (rare.stamps - together)
    half_period = max(_period(images.stamps), _period(others.stamps)) / 2
    least = least_ns if apart else max(half_period, least_ns)
    quarter = max(len(rare) // 4, MIN_PAIRS)
    start, end = np.median(differences[:quarter]), np.median(differences[-quarter:])
    middle = float(np.median(differences))
    drifts = bool(abs(end - start) > least)
    if not drifts and abs(middle) <= least:
        return None
    if not drifts and _apart(rare, often, 0) * AGREEING < _apart(rare, often, sign * middle):
        return None
    seconds, at_first, at_last = (float(value) / NANOSECONDS for value in (middle, start, end))
    return ClockOffset(seconds, at_first, at_last, drifts)


def offset_text(seconds: float, tolerance: float) -> str:
    """Seconds in as many digits as matter at a tolerance."""
    digits = max(3, 1 - math.floor(math.log10(tolerance)))
    text = f"{seconds:.{digits}f}".rstrip("0").rstrip(".")
    return text if text not in ("", "-", "-0") else "0"


def side_of(seconds: float) -> str:
    """Of a topic whose stamps are this much after others."""
    return "after" if seconds > 0 else "before"


def _rises(logs: np.ndarray) -> bool:
    """Whether the times of recording tell most messages apart."""
    return len(np.unique(logs)) * 2 > len(logs)


def _period(stamps: np.ndarray) -> float:
    """Nanoseconds from one stamp to the next, the median; 0 when all are one."""
    steps = np.diff(np.unique(stamps))
    return float(np.median(steps)) if steps.size else 0.0


def _nearest(values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Indices of the values, in any order, that are nearest to the wanted ones."""
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    right = np.clip(np.searchsorted(ordered, wanted), 1, len(ordered) - 1)
    left_is_nearer = wanted - ordered[right - 1] <= ordered[right] - wanted
    found: np.ndarray = order[np.where(left_is_nearer, right - 1, right)]
    return found


def _apart(rare: StampedTimes, often: StampedTimes, offset_ns: float) -> float:
    """Median distance, nanoseconds, of the rarer stamps less the offset to the others."""
    wanted = rare.stamps - round(offset_ns)
    stamps = often.stamps
    return float(np.median(np.abs(stamps[_nearest(stamps, wanted)] - wanted)))
