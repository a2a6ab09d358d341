"""The frames of a recording that a replay uses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice

from dyfn_core.quantities import DEPTH
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.replay.settings import Source


class SourceReader:
    """Reads what a Source asks for; it can be read any number of times.

    Attributes:
        recording: The opened recording; its notes are complete after the last frame.
        expected: Number of frames when none is lost.
    """

    def __init__(self, source: Source, quantity: str = DEPTH) -> None:
        """Open the recording.

        Args:
            source: What to read.
            quantity: What the images of the depth topic hold, one of QUANTITIES.

        Raises:
            RecordingError: The recording or one of its topics cannot be used.
            ValueError: An option is wrong.
        """
        self._source = source
        self.recording = open_recording(
            source.recording,
            source.image_topic,
            source.camera_info_topic,
            source.depth_topic,
            source.tolerance,
            depth_info_topic=source.depth_info_topic,
            depth_transform=source.depth_transform,
            stamps=source.stamps,
            quantity=quantity,
        )
        available = math.ceil(self.recording.expected_frames / source.stride)
        self.expected = min(available, source.max_frames or available)

    def frames(self) -> Iterator[RecordedFrame]:
        """Every frame asked for, in the recording's order."""
        frames = islice(self.recording.frames(), 0, None, self._source.stride)
        return islice(frames, self._source.max_frames)

    def warn(self, reason: str) -> None:
        """Note data that is there but could not be used."""
        self.recording.notes.warnings[reason] += 1

    def require(self, frames: int) -> None:
        """Check that something was read.

        Args:
            frames: How many frames were used.

        Raises:
            RecordingError: It was not one; the text has the reasons.
        """
        if frames == 0:
            reasons = "; ".join(self.recording.notes.losses) or "it holds no frames"
            raise RecordingError(f"{self._source.recording}: no frame could be used: {reasons}")
