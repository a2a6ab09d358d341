"""Images and the depth of their stamps, out of one stream of both."""

from __future__ import annotations

import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dyfn_ros.recordings.storage.base import Recorded

MAX_WAITING = 32  # frames that wait for their ground truth, and depths for their frame


@dataclass(frozen=True)
class Stamped:
    """A message with the time that counts, and the CameraInfo in force when it came."""

    stamp_ns: int
    recorded: Recorded
    info: Recorded | None = None


class Match(NamedTuple):
    """An image and its depth.

    depth: None where there is none within the tolerance, or where several would do.
    nearest_ns: stamp of the nearest depth less that of the image; None: no depth was near.
    ambiguous: several images, or several depths, have the one stamp; depth is None.
    """

    image: Stamped
    depth: Stamped | None = None
    nearest_ns: int | None = None
    ambiguous: bool = False


def match_depth(events: Iterable[Stamped], depth_topic: str, tolerance_ns: int) -> Iterator[Match]:
    """Pair images with the depth nearest in stamp within the tolerance, in the images' order.

    An image waits until an image and a depth after its stamp have come, or MAX_WAITING others
    wait. When stamps go back (a looped recording), the depths of the loop before are forgotten.
    Different images with one stamp, or different depths, cannot be told apart: they have no depth.
    """
    queue = _Queue(tolerance_ns)
    for event in events:
        if event.recorded.topic == depth_topic:
            queue.add_depth(event)
        else:
            yield from queue.add_image(event)
        while queue.ready():
            yield queue.take()
    yield from queue.rest()


class _Queue:
    """Images in order, and the latest depths."""

    def __init__(self, tolerance_ns: int) -> None:
        self._tolerance_ns = tolerance_ns
        self._images: deque[Stamped] = deque()
        self._depths: deque[Stamped] = deque(maxlen=MAX_WAITING)
        self._new: deque[Stamped] = deque(maxlen=MAX_WAITING)  # depths since the last image
        self._last: Stamped | None = None  # the last image that came
        self._repeated: set[int] = set()  # stamps that different images have

    def add_depth(self, depth: Stamped) -> None:
        self._depths.append(depth)
        self._new.append(depth)

    def add_image(self, image: Stamped) -> Iterator[Match]:
        """What has to go before it: all that waits, when stamps go back."""
        last, self._last = self._last, image
        if last is not None and image.stamp_ns < last.stamp_ns:
            yield from self.rest()
            self._repeated.clear()
            limit = image.stamp_ns + self._tolerance_ns
            self._depths = deque((d for d in self._new if d.stamp_ns <= limit), MAX_WAITING)
        elif last is not None and _differ(last, image):
            self._repeated.add(image.stamp_ns)
        self._new.clear()
        self._images.append(image)

    def ready(self) -> bool:
        if not self._images:
            return False
        stamp = self._images[0].stamp_ns
        # Depths that come much more often than images push out those that an image waits for.
        following = self._images[-1].stamp_ns > stamp or len(self._depths) == MAX_WAITING
        return len(self._images) > MAX_WAITING or (
            following and any(depth.stamp_ns > stamp for depth in self._depths)
        )

    def take(self) -> Match:
        image = self._images.popleft()
        nearest = min(self._depths, key=lambda d: abs(d.stamp_ns - image.stamp_ns), default=None)
        if nearest is None:
            return Match(image)
        distance = nearest.stamp_ns - image.stamp_ns
        if abs(distance) > self._tolerance_ns:
            return Match(image, None, distance)
        repeated = image.stamp_ns in self._repeated
        if repeated or any(_differ(nearest, other) for other in self._depths):
            return Match(image, None, distance, ambiguous=True)
        return Match(image, nearest, distance)

    def rest(self) -> Iterator[Match]:
        while self._images:
            yield self.take()


def far_apart(first: Sequence[tuple[bool, int]]) -> bool:
    """Whether images and depths of one stamp are too far apart in the file for match_depth.

    Args:
        first: Whether it is a depth, and the stamp, of the first messages in order of recording.
    """
    depths, images = (
        np.array([(at, s) for at, (depth, s) in enumerate(first) if depth is wanted]).reshape(-1, 2)
        for wanted in (True, False)
    )
    if not len(depths) or not len(images):
        return True

    def ahead(ones: np.ndarray, others: np.ndarray) -> int:
        """Of `ones`, the most that come before one of `others` though their stamps are later."""
        before, after = ones[None], others[:, None]
        both = (before[..., 0] < after[..., 0]) & (before[..., 1] > after[..., 1])
        return int(both.sum(1).max())

    return max(ahead(images, depths), ahead(depths, images)) > MAX_WAITING // 2


def match_far(
    images: Iterable[Stamped], depths: Callable[[], Iterator[Stamped]], tolerance_ns: int
) -> Iterator[Match]:
    """As match_depth, wherever in the file the depths are; they are read twice or more.

    Args:
        images: In order of recording.
        depths: Reads all depths from the first on.
        tolerance_ns: Largest distance of the stamps.
    """
    index = _Index(depths)
    waiting: Stamped | None = None
    repeated = False  # the image that waits has the stamp of another one
    for image in images:
        if waiting is not None:
            same = _differ(waiting, image)
            yield index.match(waiting, tolerance_ns, repeated or same)
            repeated = same
        waiting = image
    if waiting is not None:
        yield index.match(waiting, tolerance_ns, repeated)


class _Index:
    """The depths of a recording by their stamps; 24 bytes of each are kept."""

    def __init__(self, depths: Callable[[], Iterator[Stamped]]) -> None:
        self._read = depths
        marks = [(depth.stamp_ns, zlib.crc32(depth.recorded.data)) for depth in depths()]
        stamps = np.array([stamp for stamp, _ in marks], np.int64)
        self._order = np.argsort(stamps, kind="stable")
        self._stamps = stamps[self._order]
        self._marks = np.array([mark for _, mark in marks], np.uint32)[self._order]
        self._reader: Iterator[Stamped] = iter(())
        self._next = len(marks)  # place in the file of what the reader gives next

    def match(self, image: Stamped, tolerance_ns: int, repeated: bool) -> Match:
        if not len(self._stamps):
            return Match(image)
        place = int(np.searchsorted(self._stamps, image.stamp_ns))
        beside = range(max(place - 1, 0), min(place + 1, len(self._stamps)))
        best = min(beside, key=lambda at: abs(int(self._stamps[at]) - image.stamp_ns))
        distance = int(self._stamps[best]) - image.stamp_ns
        if abs(distance) > tolerance_ns:
            return Match(image, None, distance)
        first = np.searchsorted(self._stamps, self._stamps[best], "left")
        last = np.searchsorted(self._stamps, self._stamps[best], "right")
        if repeated or len(np.unique(self._marks[first:last])) > 1:
            return Match(image, None, distance, ambiguous=True)
        return Match(image, self._at(int(self._order[best])), distance)

    def _at(self, wanted: int) -> Stamped:
        if wanted < self._next:
            self._reader, self._next = self._read(), 0
        for depth in self._reader:
            self._next += 1
            if self._next > wanted:
                return depth
        raise AssertionError("the depths are read the same each time")


def _differ(one: Stamped, other: Stamped) -> bool:
    """Whether two messages have one stamp and different content."""
    return one.stamp_ns == other.stamp_ns and one.recorded.data != other.recorded.data
