"""Images and the depth of their stamps, out of one stream of both."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from dyfn_ros.recordings.storage.base import Recorded

MAX_WAITING = 32  # frames that wait for their ground truth, and depths for their frame


@dataclass(frozen=True)
class Stamped:
    """A message with the time that counts, and the CameraInfo in force when it came."""

    stamp_ns: int
    recorded: Recorded
    info: Recorded | None = None


def match_depth(
    events: Iterable[Stamped], depth_topic: str, tolerance_ns: int
) -> Iterator[tuple[Stamped, Stamped | None]]:
    """Pair images with the depth nearest in stamp within the tolerance, in the images' order.

    An image waits until a depth at or after its stamp has come, or MAX_WAITING others wait.
    When stamps go back (a looped recording), the depths of the loop before are forgotten.
    """
    images: deque[Stamped] = deque()
    depths: deque[Stamped] = deque(maxlen=MAX_WAITING)
    new: deque[Stamped] = deque(maxlen=MAX_WAITING)  # depths since the last image
    last: int | None = None

    def pair() -> tuple[Stamped, Stamped | None]:
        image = images.popleft()
        nearest = min(depths, key=lambda d: abs(d.stamp_ns - image.stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - image.stamp_ns) > tolerance_ns:
            return image, None
        return image, nearest

    for event in events:
        if event.recorded.topic == depth_topic:
            depths.append(event)
            new.append(event)
        else:
            if last is not None and event.stamp_ns < last:
                while images:
                    yield pair()
                limit = event.stamp_ns + tolerance_ns
                depths = deque((d for d in new if d.stamp_ns <= limit), maxlen=MAX_WAITING)
            last = event.stamp_ns
            new.clear()
            images.append(event)
        while images and (
            len(images) > MAX_WAITING or any(d.stamp_ns >= images[0].stamp_ns for d in depths)
        ):
            yield pair()
    while images:
        yield pair()
