"""Images and the depth of their stamps, out of one stream of both."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

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


def _differ(one: Stamped, other: Stamped) -> bool:
    """Whether two messages have one stamp and different content."""
    return one.stamp_ns == other.stamp_ns and one.recorded.data != other.recorded.data
