"""The frames of a recording that a replay uses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

from dyfn_core.metric.references import Reference
from dyfn_core.quantities import DEPTH
from dyfn_core.scoring.plausibility import Plausibility, Remedies
from dyfn_ros.messages.references import message_references
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.recordings.image_recording import ImageRecording
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.reference_topic import ReferenceTopic
from dyfn_ros.recordings.rgbd_folder import RgbdRecording
from dyfn_ros.recordings.transform_topics import TransformFeed
from dyfn_ros.replay.pose_feed import PoseFeed
from dyfn_ros.replay.settings import SessionOptions, Source

REMEDIES = Remedies(
    unit="; --depth-scale gives the stored values per metre",
    far="; --depth-max leaves them out",
    stamps="; --stamps log takes the time of recording",
    truth="; --depth-topic names another, --depth-info-topic and --depth-transform register it",
    camera="; --camera-info-topic none does without",
)


class ReferenceFeed:
    """The measurements of a recording, each with the first frame that is recorded after it."""

    def __init__(
        self,
        topic: ReferenceTopic,
        decode: Callable[[Any, float], Reference],
        is_truth: bool,
        transforms: TransformFeed | None = None,
    ) -> None:
        """Begin at the first measurement.

        Args:
            topic: Where they are.
            decode: Makes a measurement of a message and its stamp (seconds).
            is_truth: Whether the scores are of the same topic.
            transforms: What decoding needs to have been read; None: nothing.
        """
        self.topic = topic
        self.is_truth = is_truth
        self._decode, self._transforms = decode, transforms

    def before(self, frame: RecordedFrame) -> Iterator[tuple[float, Reference]]:
        """Stamp (seconds) and measurement of what was recorded up to a frame, once each."""
        if self._transforms is not None:
            self._transforms.until(frame.source.log_ns)
        for stamp, message in self.topic.until(frame.source.log_ns):
            yield stamp, self._decode(message, stamp)

    def losses(self) -> dict[str, int]:
        """Messages that could not be read, with how often."""
        found = dict(self.topic.losses)
        return found if self._transforms is None else found | dict(self._transforms.losses)


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
            depth_scale=source.depth_scale,
            depth_offset=source.depth_offset,
            image_bits=source.image_bits,
        )
        available = math.ceil(self.recording.expected_frames / source.stride)
        self.expected = min(available, source.max_frames or available)
        self._remedies = replace(REMEDIES, stamps="") if source.stamps == "log" else REMEDIES
        self._plausibility = Plausibility(self.expected, self._remedies)

    def frames(self) -> Iterator[RecordedFrame]:
        """Every frame asked for, in the recording's order."""
        return (frame for frame, used in self.every() if used)

    def every(self) -> Iterator[tuple[RecordedFrame, bool]]:
        """Every frame up to the last one asked for, and whether it is: the stride leaves some
        out."""
        self._plausibility = Plausibility(self.expected, self._remedies)
        stride, count = self._source.stride, 0
        with closing(self.recording.frames()) as every:
            for index, frame in enumerate(every):
                used = index % stride == 0
                if used:
                    stamp, camera = frame.stamp_ns, frame.camera_matrix
                    self._plausibility.push(frame.image, frame.depth, stamp, camera)
                yield frame, used
                count += used
                if count == self._source.max_frames:
                    return

    def doubts(self, scored: int, depth_max: float) -> list[str]:
        """What makes the scores of the frames implausible, a sentence each.

        Args:
            scored: How many of the frames were scored.
            depth_max: Metres up to which.
        """
        expected = None if self.recording.topics.depth is None else scored
        return [*self.recording.doubts(), *self._plausibility.warnings(expected, depth_max)]

    def references(self, options: SessionOptions) -> ReferenceFeed | None:
        """The measurements of the reference topic, from the first on.

        Args:
            options: Whether there are any, what they are, and where the sensor is.

        Returns:
            None when the metric source is none that measures.

        Raises:
            RecordingError: The recording has no such topic.
            ValueError: An option of the reference is wrong.
        """
        source = self._source
        if options.metric_source != "reference":
            return None
        if isinstance(self.recording, (RgbdRecording, ImageRecording)):
            raise RecordingError(
                f"{source.recording}: metric_source is 'reference', expected a recording with a "
                f"topic of {options.reference_type}; an RGB-D folder or a video has none"
            )
        kind = f"sensor_msgs/msg/{options.reference_type}"
        topic = ReferenceTopic(source.recording, source.reference_topic, kind, source.stamps)

        def unreadable(reason: str) -> None:
            self.recording.notes.losses[f"{topic.name}: measurement skipped: {reason}"] += 1

        is_truth = topic.name == self.recording.topics.depth
        if options.reference_transform.strip():
            return ReferenceFeed(topic, message_references(options, unreadable), is_truth)
        feed = TransformFeed(source.recording, options.pose_limits, source.stamps)
        decode = message_references(options, unreadable, feed.buffer)
        return ReferenceFeed(topic, decode, is_truth, feed)

    def poses(self, options: SessionOptions) -> PoseFeed | None:
        """The camera's poses, from the first frame on.

        Args:
            options: Whether they are wanted, what they are of, and where the camera is.

        Returns:
            None when the metric source is not odometry.

        Raises:
            RecordingError: The recording has no such topic.
            ValueError: An option of the odometry is wrong.
        """
        if options.metric_source != "odometry":
            return None
        if isinstance(self.recording, ImageRecording):
            raise RecordingError(
                f"{self._source.recording}: metric_source is 'odometry', expected a recording "
                "with poses; a video or a folder of pictures has none"
            )
        return PoseFeed(self._source, options, self.expected)

    def warn(self, reason: str, times: int = 1) -> None:
        """Note data that is there but could not be used."""
        self.recording.notes.warnings[reason] += times

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
