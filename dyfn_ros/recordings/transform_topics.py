"""/tf and /tf_static of a recording, read in the order of recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Literal

from dyfn_core.metric.pose_limits import PoseLimits
from dyfn_ros.messages.transforms import TransformBuffer
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.storage.base import Recorded
from dyfn_ros.recordings.storage.open import open_storage
from dyfn_ros.recordings.typestore import TF

STATIC = "tf_static"


class TransformFeed:
    """The transforms of a recording, as a node would have met them.

    Static ones count from the start, since the live topic is latched.

    Attributes:
        buffer: What has been read.
        losses: Messages that could not be read, each reason with its count.
    """

    def __init__(
        self, path: Path, limits: PoseLimits, stamps: Literal["header", "log"] = "header"
    ) -> None:
        """Read the static transforms.

        Args:
            path: A recording of ROS messages.
            limits: Of what moves.
            stamps: Times of the headers, or of the log.
        """
        storage = open_storage(path)
        names = {name for name, topic in storage.topics.items() if topic.kind == TF and topic.count}
        static = {name for name in names if name.endswith(STATIC)}
        self.buffer = TransformBuffer(limits)
        self.losses: Counter[str] = Counter()
        self._log_time = stamps == "log"
        for recorded in storage.messages(static) if static else ():
            self._take(recorded, True)
        self._messages = iter(storage.messages(names - static) if names - static else ())
        self._next: Recorded | None = next(self._messages, None)

    def until(self, log_ns: int) -> None:
        """Read what was recorded up to a time (nanoseconds)."""
        while self._next is not None and self._next.log_ns <= log_ns:
            recorded, self._next = self._next, next(self._messages, None)
            self._take(recorded, False)

    def _take(self, recorded: Recorded, static: bool) -> None:
        try:
            message = recorded.message()
        except RecordingError as error:
            self.losses[str(error)] += 1
            return
        self.buffer.take(message, static, recorded.log_ns if self._log_time else None)
