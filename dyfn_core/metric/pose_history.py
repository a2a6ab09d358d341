"""Where a body was, by its odometry: stamped poses in, the pose of a moment out, or why not."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dyfn_core.geometry.rigid import between, inverse, size_of
from dyfn_core.metric.motion import pose_problem
from dyfn_core.metric.pose_limits import PoseLimits

SECOND = 1_000_000_000  # stamps are whole nanoseconds: float64 seconds since 1970 are off by 240

# Why a pose is not taken, or what it breaks with.
NO_POSE, DUPLICATE = "no rigid pose", "stamp came before"
WENT_BACK, JUMP = "time went back", "jump"
# Why there is no pose at a moment; JUMP as well.
NONE_YET, BEFORE, GONE = "none has come yet", "before the first", "older than what is kept"
LATE, STALE, GAP, OTHER_CLOCK = "not there yet", "stale", "gap", "another clock"

_STILL_LATE = 1.0  # seconds behind which poses that keep coming are of another clock
_JITTER = 0.02  # metres, or radians, by which stamps that are not exact move a pose


@dataclass(frozen=True)
class Placed:
    """A pose at a moment.

    Attributes:
        pose: 4 x 4 float64, body to world.
        variance: Rotation (rad^2) and translation (m^2) per axis, summed up along the way to this
            pose; None when a pose beside it has none. A jump adds its own square.
    """

    pose: np.ndarray
    variance: tuple[float, float] | None = None


@dataclass(frozen=True)
class NoPose:
    """Why there is no pose at a moment.

    Attributes:
        reason: One of the few above, to be counted.
        detail: The same with its values, as part of a sentence.
    """

    reason: str
    detail: str


class _Kept(NamedTuple):
    pose: np.ndarray
    stretch: int  # jumps before it
    variance: tuple[float, float] | None


class PoseHistory:
    """The poses of one body, for any thread; a moment's pose depends on those around it alone.

    A pose that comes late finds its place. A stamp that goes back by more than `limits.back` (a
    recording that loops, a clock that was set) ends the history before it.

    Attributes:
        limits: See PoseLimits.
        counts: Poses that were not taken, and breaks, by reason.
    """

    def __init__(self, limits: PoseLimits | None = None) -> None:
        self.limits = limits or PoseLimits()
        self.counts: Counter[str] = Counter()
        self._stamps: list[int] = []
        self._kept: list[_Kept] = []
        self._total: tuple[float, float] | None = None  # variance up to the last known one
        self._dropped = False  # whether older poses have made room
        self._taken = 0
        self._seen = -1  # _taken at the last question beyond the newest pose
        self._lock = threading.RLock()

    @property
    def newest(self) -> int | None:
        """Stamp of the newest pose in nanoseconds; None before the first."""
        with self._lock:
            return self._stamps[-1] if self._stamps else None

    def add(
        self, stamp: int, pose: np.ndarray, growth: tuple[float, float] | None = None
    ) -> NoPose | None:
        """Take the next pose.

        Args:
            stamp: Nanoseconds.
            pose: 4 x 4, body to world, metres.
            growth: Variance of the motion from the pose before to this one: rotation (rad^2) and
                translation (m^2), per axis. None: unknown.

        Returns:
            Why it was not taken, or what it breaks with (it was then taken); None for nothing.
        """
        pose = np.array(pose, np.float64)
        with self._lock:
            found = self._refused(stamp, pose) or self._insert(stamp, pose, growth)
            if found is not None:
                self.counts[found.reason] += 1
            return found

    def reaches(self, stamp: int) -> bool:
        """Whether no later pose can change the pose at this moment (nanoseconds)."""
        newest = self.newest
        return newest is not None and newest >= stamp

    def at(self, stamp: int) -> Placed | NoPose:
        """The pose at a moment.

        Args:
            stamp: Nanoseconds.

        Returns:
            Interpolated between the poses before and after it; up to `limits.tolerance` beyond
            either end the motion of as long a time inside goes on, or the last pose stands where
            nothing is known of that time. Else the reason.
        """
        with self._lock:
            inside = self._inside(stamp)
            if inside is not None:
                return inside
            after = bisect_left(self._stamps, stamp)
            ends = [i for i in (after - 1, after) if 0 <= i < len(self._stamps)]
            end = min(ends, key=lambda i: abs(self._stamps[i] - stamp), default=None)
            reach = round(self.limits.tolerance * SECOND)
            if end is None or abs(self._stamps[end] - stamp) > reach:
                return self._why(stamp, after)
            return self._beyond(stamp, end)

    # With the lock held.

    def _refused(self, stamp: int, pose: np.ndarray) -> NoPose | None:
        if problem := pose_problem(pose):
            return NoPose(NO_POSE, problem)
        if self._stamps and self._stamps[-1] - stamp > self.limits.back * SECOND:
            back = (self._stamps[-1] - stamp) / SECOND
            self._stamps, self._kept, self._dropped = [], [], False
            self._place(0, stamp, pose, self._total, 0)
            return NoPose(WENT_BACK, f"stamps went back by {back:.3g} s: earlier poses are gone")
        place = bisect_left(self._stamps, stamp)
        if place < len(self._stamps) and self._stamps[place] == stamp:
            return NoPose(DUPLICATE, f"stamp {stamp / SECOND:.9f} came before")
        return None

    def _insert(
        self, stamp: int, pose: np.ndarray, growth: tuple[float, float] | None
    ) -> NoPose | None:
        place = bisect_left(self._stamps, stamp)
        if place < len(self._stamps):  # late: what is known of the way stays as it is
            before = self._kept[place - 1] if place else self._kept[place]
            self._place(place, stamp, pose, before.variance, before.stretch)
            return None
        turn, move, jump = self._step(stamp, pose)
        stretch = self._kept[-1].stretch if self._kept else 0
        if growth is not None:
            rotation, translation = self._total or (0.0, 0.0)
            extra = (turn**2 / 3, move**2 / 3) if jump else (0.0, 0.0)
            self._total = (rotation + growth[0] + extra[0], translation + growth[1] + extra[1])
        total = None if growth is None else self._total
        self._place(place, stamp, pose, total, stretch + (jump is not None))
        return jump

    def _step(self, stamp: int, pose: np.ndarray) -> tuple[float, float, NoPose | None]:
        """From the newest pose to this one: radians, metres, and whether that is a jump."""
        if not self._stamps:
            return 0.0, 0.0, None
        seconds = (stamp - self._stamps[-1]) / SECOND
        turn, move = size_of(inverse(self._kept[-1].pose) @ pose)
        limits = self.limits
        for size, most, what in ((move, limits.speed, "m"), (turn, limits.turn, "rad")):
            if size > most * seconds + _JITTER:
                text = f"{size:.3g} {what} in {seconds:.3g} s, at most {most:g} {what}/s expected"
                return turn, move, NoPose(JUMP, f"jumped by {text}")
        return turn, move, None

    def _place(
        self,
        place: int,
        stamp: int,
        pose: np.ndarray,
        variance: tuple[float, float] | None,
        stretch: int,
    ) -> None:
        self._stamps.insert(place, stamp)
        self._kept.insert(place, _Kept(pose, stretch, variance))
        self._taken += 1
        capacity = self.limits.capacity
        if capacity is not None and len(self._stamps) > capacity:
            old = max(1, capacity // 10)  # in one piece: each removal moves the whole list
            del self._stamps[:old], self._kept[:old]
            self._dropped = True

    def _inside(self, stamp: int) -> Placed | None:
        """Where there is a pose at the stamp, or one before and one after it that belong to it."""
        after = bisect_left(self._stamps, stamp)
        if after < len(self._stamps) and self._stamps[after] == stamp:
            return Placed(self._kept[after].pose.copy(), self._kept[after].variance)
        if not 0 < after < len(self._stamps):
            return None
        begin, end = self._stamps[after - 1], self._stamps[after]
        first, second = self._kept[after - 1], self._kept[after]
        if end - begin > self.limits.gap * SECOND or first.stretch != second.stretch:
            return None
        share = (stamp - begin) / (end - begin)
        variance = None
        if first.variance is not None and second.variance is not None:
            pairs = zip(first.variance, second.variance, strict=True)
            rotation, translation = (a + share * (b - a) for a, b in pairs)
            variance = (rotation, translation)
        return Placed(between(first.pose, second.pose, share), variance)

    def _beyond(self, stamp: int, end: int) -> Placed:
        last, distance = self._kept[end], stamp - self._stamps[end]
        inner = self._inside(self._stamps[end] - distance)
        if inner is None:
            return Placed(last.pose.copy(), last.variance)
        return Placed(last.pose @ (inverse(inner.pose) @ last.pose), last.variance)

    def _why(self, stamp: int, after: int) -> NoPose:
        if not self._stamps:
            return NoPose(NONE_YET, "no pose has come yet")
        if after == len(self._stamps):
            return self._why_behind((stamp - self._stamps[-1]) / SECOND)
        if after == 0:
            return self._why_ahead(stamp)
        if self._kept[after - 1].stretch != self._kept[after].stretch:
            return NoPose(JUMP, "a jump of the poses is at the image's stamp")
        gap = (self._stamps[after] - self._stamps[after - 1]) / SECOND
        text = f"the poses around the image are {gap:.3g} s apart, at most {self.limits.gap:g} used"
        return NoPose(GAP, text)

    def _why_behind(self, seconds: float) -> NoPose:
        moving, self._seen = self._taken != self._seen, self._taken
        text = f"the newest pose is {_rounded(seconds)} s older than the image"
        if seconds <= _STILL_LATE:
            return NoPose(LATE, text)
        if not moving:
            return NoPose(STALE, f"no new pose since, {text}")
        return NoPose(OTHER_CLOCK, f"another clock? {text}")

    def _why_ahead(self, stamp: int) -> NoPose:
        oldest, newest = ((end - stamp) / SECOND for end in (self._stamps[0], self._stamps[-1]))
        text = f"the oldest pose is {_rounded(oldest)} s younger than the image"
        if self._dropped:
            return NoPose(GONE, text)
        if oldest <= _STILL_LATE:
            return NoPose(BEFORE, text)
        text = f"the newest pose is {_rounded(newest)} s younger than the image"
        return NoPose(OTHER_CLOCK, f"another clock? {text}")


def _rounded(seconds: float) -> str:
    """To two digits: a text that is nearly the same each time is logged once."""
    digits = max(0, 1 - math.floor(math.log10(seconds))) if seconds > 0 else 0
    return f"{seconds:.{digits}f}"
