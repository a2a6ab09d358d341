"""The measurements of a recording that a metric scale is made from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.storage.base import Recorded
from dyfn_ros.recordings.storage.open import open_storage
from dyfn_ros.recordings.topics import choose_reference


class ReferenceTopic:
    """One topic of distance measurements, read once, in the order of recording.

    Attributes:
        name: The topic as it is recorded.
        losses: What could not be read so far, each reason with its count.
    """

    def __init__(
        self,
        path: Path,
        name: str | None,
        kind: str,
        stamps: Literal["header", "log"] = "header",
    ) -> None:
        """Open the topic.

        Args:
            path: A recording of ROS messages.
            name: The topic; None: the only one of its type.
            kind: Message type, such as "sensor_msgs/msg/PointCloud2".
            stamps: Times of the headers, or of the log.

        Raises:
            RecordingError: The recording cannot be opened, or has no such topic.
        """
        storage = open_storage(path)
        self.name = choose_reference(path, storage, name, kind)
        self.losses: Counter[str] = Counter()
        self._log_time = stamps == "log"
        self._messages = storage.messages([self.name])
        self._next: Recorded | None = next(self._messages, None)

    def until(self, log_ns: int) -> Iterator[tuple[float, Any]]:
        """The messages that were recorded up to a time, and not given out before.

        Args:
            log_ns: Time of recording, nanoseconds.

        Yields:
            Stamp in seconds, and message.
        """
        while self._next is not None and self._next.log_ns <= log_ns:
            recorded, self._next = self._next, next(self._messages, None)
            try:
                message = recorded.message()
            except RecordingError as error:
                self.losses[str(error)] += 1
                continue
            stamp = message.header.stamp
            seconds, rest = stamp.sec, stamp.nanosec
            if self._log_time:
                seconds, rest = divmod(recorded.log_ns, 1_000_000_000)
            yield seconds + rest * 1e-9, message
