"""Frames out of the messages of a recording."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dyfn_core.prediction import DEPTH
from dyfn_ros.messages.compressed_image import decode_compressed
from dyfn_ros.messages.encodings import FULL_BITS, MessageError, doubted_bits
from dyfn_ros.messages.images import decode_image
from dyfn_ros.messages.rectify import PinholeImage, Rectifier, RectifyRules, is_rectified
from dyfn_ros.messages.references import Transform
from dyfn_ros.recordings.clocks import StampedTimes, clock_offset, offset_text, side_of
from dyfn_ros.recordings.depth_matching import (
    MAX_WAITING,
    Match,
    Stamped,
    far_apart,
    match_depth,
    match_far,
)
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import Notes, RecordedFrame
from dyfn_ros.recordings.ground_truth import GroundTruth
from dyfn_ros.recordings.storage.base import Recorded, Storage
from dyfn_ros.recordings.topics import Topics, topic_remarks
from dyfn_ros.recordings.typestore import COMPRESSED_IMAGE
from dyfn_ros.recordings.video_topic import VideoTopic, is_video


class BagRecording:
    """Frames of a recording of ROS messages."""

    def __init__(
        self,
        path: Path,
        storage: Storage,
        topics: Topics,
        tolerance: float,
        transform: Transform | None = None,
        stamps: Literal["header", "log"] = "header",
        quantity: str = DEPTH,
        depth_scale: float | None = None,
        depth_offset: float = 0.0,
        image_bits: int = FULL_BITS,
    ) -> None:
        self.path = path
        self.topics = topics
        self.notes = Notes()
        self._rules = RectifyRules(rectified=is_rectified(topics.image))
        self._storage = storage
        self._tolerance_ns = round(tolerance * 1e9)
        self._truth = GroundTruth(transform, self._assumed, quantity, depth_scale)
        self._log_time = stamps == "log"
        self._depth_offset_ns = round(depth_offset * 1e9)
        self._image_bits = image_bits
        self._matched = 0  # images with a depth
        self._offsets: list[int] = []  # of the nearest depth beyond the tolerance, ns
        self._image_times, self._depth_times = StampedTimes(), StampedTimes()

    @property
    def expected_frames(self) -> int:
        """See Recording."""
        return self._storage.topics[self.topics.image].count

    def frames(self) -> Generator[RecordedFrame, None, None]:
        """See Recording."""
        self.notes = Notes()
        self.notes.warnings.update(topic_remarks(self._storage, self.topics))
        self.notes.warnings.update(self._storage.remarks)
        infos = _Infos(self._first(self.topics.camera_info), self._unusable)
        depth_infos = _Infos(self._first(self.topics.depth_info), self._assumed)
        calibrator = Rectifier(self._unusable)
        index = 0
        try:
            for match in self._matches():
                infos.recorded = match.image.info or infos.recorded
                if match.depth is not None:
                    depth_infos.recorded = match.depth.info or depth_infos.recorded
                frame = self._decode(index, match, infos, depth_infos, calibrator)
                if frame is not None:
                    index += 1
                    yield frame
        finally:  # also when no more frames are wanted
            self.notes.losses.update([*self.topics.lost, *self._storage.losses])

    def doubts(self) -> list[str]:
        """See Recording."""
        if self.topics.depth is None or self._log_time:
            return []
        tolerance = self._tolerance_ns * 1e-9
        images = self._image_times
        if still := self._standing_stamps():
            return [still]
        apart = 2 * self._matched < len(images)
        found = clock_offset(images, self._depth_times, self._tolerance_ns, apart)
        if found is not None and found.drifts:
            start, end = (
                f"{offset_text(abs(value), tolerance)} s {side_of(value)}"
                for value in (found.start, found.end)
            )
            return [
                f"{self.topics.depth}: its stamps are {start} those of the images recorded with "
                f"them at first and {end} at last: one clock drifts; --stamps log takes the time "
                "of recording"
            ]
        if found is not None:
            return [self._doubted_offset(found.seconds, "images recorded at the same time")]
        if self._offsets and self._matched == 0:
            nearest = float(np.median(self._offsets)) * 1e-9
            return [self._doubted_offset(nearest, "the images nearest to them")]
        return []

    def _standing_stamps(self) -> str:
        """Says that one of the topics has one stamp in all of its messages."""
        both = {self.topics.image: self._image_times, self.topics.depth: self._depth_times}
        still = [n for n, times in both.items() if len(times) > 2 and np.ptp(times.stamps) == 0]
        if len(still) != 1:
            return ""
        (name,) = still
        stamp = int(both[name].stamps[0]) * 1e-9
        return (
            f"{name}: all of its {len(both[name])} messages have the stamp {stamp:g} s; --stamps "
            "log takes the time of recording"
        )

    def _doubted_offset(self, seconds: float, what: str) -> str:
        tolerance = self._tolerance_ns * 1e-9
        there = self._depth_offset_ns * 1e-9
        mend = offset_text(there + seconds, tolerance)
        corrected = f", less --depth-offset {there:g}," if there else ""
        return (
            f"{self.topics.depth}: its stamps{corrected} are "
            f"{offset_text(abs(seconds), tolerance)} s {side_of(seconds)} those of {what} (median, "
            f"--tolerance {tolerance:g}); if they are of another clock, --depth-offset {mend} "
            "takes that away, and --stamps log takes the time of recording"
        )

    def _matches(self) -> Iterator[Match]:
        self._matched, self._offsets = 0, []
        image, depth = self.topics.image, self.topics.depth
        if depth is None:
            self._image_times, self._depth_times = StampedTimes(), StampedTimes()
            return (Match(image) for image in self._events({image}))
        far = self._far_apart(image, depth)
        self._image_times, self._depth_times = StampedTimes(), StampedTimes()
        if far:
            images, depths = self._events({image}), partial(self._events, {depth})
            return match_far(images, depths, self._tolerance_ns)
        return match_depth(self._events({image, depth}), depth, self._tolerance_ns)

    def _far_apart(self, image: str, depth: str) -> bool:
        """Whether the first messages say so; what is wrong with them is noted later."""
        notes, self.notes = self.notes, Notes()
        first = islice(self._events({image, depth}), 2 * MAX_WAITING)
        far = far_apart([(one.recorded.topic == depth, one.stamp_ns) for one in first])
        self.notes = notes
        return far

    def _first(self, topic: str | None) -> Recorded | None:
        return next(iter(self._storage.messages([topic] if topic else [])), None)

    def _events(self, wanted: set[str]) -> Iterator[Stamped]:
        """Images and depths, each with the CameraInfo of its time, in log-time order."""
        topics = self.topics
        both = {topics.image: topics.camera_info, topics.depth: topics.depth_info}
        sources = {topic: info for topic, info in both.items() if topic in wanted}
        infos: dict[str, Recorded] = {}
        read = {topic for pair in sources.items() for topic in pair if topic}
        for recorded in self._messages(read):
            if recorded.topic not in sources:
                infos[recorded.topic] = recorded
                continue
            stamped = self._stamped(recorded)
            if stamped is not None:
                yield replace(stamped, info=infos.get(sources[recorded.topic] or ""))

    def _messages(self, wanted: set[str]) -> Iterator[Recorded]:
        """Those of the storage; of compressed video its pictures."""
        if self.topics.image not in wanted or not is_video(self._first(self.topics.image)):
            yield from self._storage.messages(wanted)
            return
        video = VideoTopic(self.topics.image, lambda reason: self.notes.losses.update([reason]))
        for recorded in self._storage.messages(wanted):
            yield from video.take(recorded)
        yield from video.rest()

    def _stamped(self, recorded: Recorded) -> Stamped | None:
        try:
            stamp = recorded.message().header.stamp
        except RecordingError as error:
            self.notes.losses[str(error)] += 1
            return None
        is_depth, log_ns = recorded.topic == self.topics.depth, recorded.log_ns
        stamp_ns = log_ns if self._log_time else stamp.sec * 1_000_000_000 + stamp.nanosec
        if is_depth:
            stamp_ns -= self._depth_offset_ns
        (self._depth_times if is_depth else self._image_times).add(stamp_ns, log_ns)
        return Stamped(stamp_ns, recorded)

    def _unusable(self, reason: str) -> None:
        """Noted once, however many frames it is in force for."""
        self.notes.warnings[f"{self.topics.camera_info}: {reason}"] = 1

    def _assumed(self, reason: str) -> None:
        self.notes.warnings[f"{self.topics.depth}: {reason}"] = 1

    def _decode(
        self,
        index: int,
        match: Match,
        infos: _Infos,
        depth_infos: _Infos,
        calibrator: Rectifier,
    ) -> RecordedFrame | None:
        image = match.image
        message = image.recorded.message()
        frame_id = str(message.header.frame_id)
        try:
            pixels = self._pixels(image.recorded, message)
            view = calibrator.view(pixels, frame_id, infos.message(), self._rules)
        except MessageError as error:
            self.notes.losses[f"{image.recorded.topic}: image skipped: {error}"] += 1
            return None
        return RecordedFrame(
            index=index,
            stamp_ns=image.stamp_ns,
            frame_id=frame_id,
            image=view.image,
            camera_matrix=view.matrix,
            depth=self._decode_depth(match, depth_infos.message(), view, frame_id),
            source=image.recorded,
            info=infos.recorded,
            visible=view.visible,
            lens_undone=view.lens is not None,
        )

    def _pixels(self, recorded: Recorded, message: Any) -> np.ndarray:
        bits = self._image_bits

        def damaged(text: str) -> None:
            self.notes.warnings[f"{recorded.topic}: {text}"] += 1

        if recorded.kind == COMPRESSED_IMAGE:
            kind, pixels = message.format, decode_compressed(message, bits=bits, damaged=damaged)
        else:
            kind, pixels = message.encoding, decode_image(message, bits=bits)
        if doubt := doubted_bits(str(kind), pixels, bits):
            self.notes.warnings[f"{recorded.topic}: {doubt}, give --image-bits 12"] += 1
        return pixels

    def _decode_depth(
        self, match: Match, info: Any, view: PinholeImage, frame_id: str
    ) -> np.ndarray | None:
        if match.depth is None:
            self._note_unmatched(match)
            return None
        self._matched += 1
        try:
            return self._truth.decode(match.depth.recorded, info, view, frame_id)
        except MessageError as error:
            self.notes.losses[f"{match.depth.recorded.topic}: depth skipped: {error}"] += 1
            return None

    def _note_unmatched(self, match: Match) -> None:
        if self.topics.depth is None:
            return
        reason = "no depth at an image's stamp"
        if match.ambiguous:
            reason += (
                " is used where several images or depths have that stamp: nothing tells which "
                "belong together (--stamps log takes the time of recording)"
            )
        elif match.nearest_ns is not None:
            self._offsets.append(match.nearest_ns)
        self.notes.warnings[f"{self.topics.depth}: {reason}"] += 1


class _Infos:
    """The CameraInfo in force, deserialised once per content."""

    def __init__(self, first: Recorded | None, warn: Callable[[str], None]) -> None:
        self.recorded = first
        self._warn = warn
        self._known: tuple[bytes, Any] | None = None

    def message(self) -> Any:
        """None without one, or with one that cannot be read."""
        if self.recorded is None:
            return None
        content = self.recorded.data[12:]  # all but the CDR head and the stamp
        if self._known is None or self._known[0] != content:
            try:
                self._known = (content, self.recorded.message())
            except RecordingError as error:
                self._warn(str(error))
                self._known = (content, None)
        return self._known[1]
