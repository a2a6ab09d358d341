"""Recordings as sequences of frames: image, intrinsics and ground truth, matched by stamp."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dyfn_ros.calibration import CalibrationRules, Calibrator, undistort_depth
from dyfn_ros.compressed_depth import decode_compressed_depth
from dyfn_ros.compressed_image import decode_compressed
from dyfn_ros.encodings import MessageError
from dyfn_ros.messages import decode_depth, decode_image
from dyfn_ros.recording_writer import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    TYPES,
    RecordingError,
    RecordingWriter,
    RgbdFrame,
    camera_info,
    image_message,
    write_rgbd_recording,
)
from dyfn_ros.rgbd_folder import IMAGE_SUFFIXES, is_rgbd_folder, numbered, read_rgbd_folder
from dyfn_ros.storage import Recorded, Storage, open_storage
from dyfn_ros.topics import Topics, choose_topics

__all__ = [
    "RecordedFrame",
    "Recording",
    "RecordingError",
    "RecordingWriter",
    "RgbdFrame",
    "open_recording",
    "write_rgbd_recording",
]

MAX_WAITING = 32  # frames that wait for their ground truth, and depths for their frame


@dataclass(frozen=True)
class RecordedFrame:
    """One colour frame of a recording.

    index: 0, 1, 2 ... over the frames that could be read.
    stamp_ns: the header's stamp. frame_id: the header's.
    image: H x W x 3 uint8 RGB, lens distortion undone (and that of depth), as the node does.
    camera_matrix: 3 x 3 float64 in pixels; None without usable calibration.
    depth: H' x W' float32 metres, NaN invalid; None without ground truth for this stamp.
    visible: H x W bool, where undistortion found a picture; None: everywhere.
    source, info: the image and the latest CameraInfo as recorded (or made, for an RGB-D folder).
    """

    index: int
    stamp_ns: int
    frame_id: str
    image: np.ndarray
    camera_matrix: np.ndarray | None
    depth: np.ndarray | None
    source: Recorded
    info: Recorded | None
    visible: np.ndarray | None = None


@dataclass
class Notes:
    """What went wrong on the way, each reason once with its count.

    losses: data that is gone. warnings: data that is there but could not be used.
    """

    losses: Counter[str] = field(default_factory=Counter)
    warnings: Counter[str] = field(default_factory=Counter)


class Recording(Protocol):
    """An opened recording. notes is complete only after frames() has been exhausted."""

    path: Path
    topics: Topics
    notes: Notes

    @property
    def expected_frames(self) -> int:
        """How many images the recording says it has."""

    def frames(self) -> Iterator[RecordedFrame]:
        """Every frame in log-time order, always the same for the same recording."""


def open_recording(
    path: str | Path,
    image_topic: str | None = None,
    camera_info_topic: str | None = None,
    depth_topic: str | None = None,
    tolerance: float = 0.02,
) -> Recording:
    """Open a rosbag2 folder, a bare .mcap or .db3 file, or an RGB-D folder.

    A topic that is None is found by type when there is one candidate; "none" means to do without
    (camera info, depth). tolerance: seconds between the stamps of an image and its ground truth.
    Raises RecordingError: not a recording, nothing readable, no image topic, or several
    candidates, which are then listed with their types.
    """
    path = Path(path)
    if path.is_dir() and is_rgbd_folder(path):
        return FolderRecording(path)
    storage = open_storage(path)
    topics = choose_topics(path, storage, image_topic, camera_info_topic, depth_topic)
    return RosRecording(path, storage, topics, tolerance)


class RosRecording:
    """Frames of a rosbag2 recording."""

    def __init__(self, path: Path, storage: Storage, topics: Topics, tolerance: float) -> None:
        self.path = path
        self.topics = topics
        self.notes = Notes()
        self._rules = CalibrationRules()
        self._storage = storage
        self._tolerance_ns = round(tolerance * 1e9)

    @property
    def expected_frames(self) -> int:
        """See Recording."""
        return self._storage.topics[self.topics.image].count

    def frames(self) -> Iterator[RecordedFrame]:
        """See Recording."""
        self.notes = Notes()
        infos = _Infos(self._first_info())
        calibrator = Calibrator(self._unusable)
        index = 0
        for image, depth in self._pairs():
            infos.recorded = image.info or infos.recorded
            frame = self._decode(index, image, depth, infos, calibrator)
            if frame is not None:
                index += 1
                yield frame
        self.notes.losses.update(self._storage.losses)

    def _pairs(self) -> Iterator[tuple[_Stamped, _Stamped | None]]:
        if self.topics.depth is None:
            return ((image, None) for image in self._events())
        return match_depth(self._events(), self.topics.depth, self._tolerance_ns)

    def _first_info(self) -> Recorded | None:
        wanted = [t for t in (self.topics.camera_info,) if t]
        return next(iter(self._storage.messages(wanted)), None)

    def _events(self) -> Iterator[_Stamped]:
        """Images, each with the CameraInfo of its time, and depths, in log-time order."""
        wanted = {t for t in (self.topics.image, self.topics.depth, self.topics.camera_info) if t}
        info: Recorded | None = None
        for recorded in self._storage.messages(wanted):
            if recorded.topic == self.topics.camera_info:
                info = recorded
                continue
            stamped = self._stamped(recorded)
            if stamped is not None:
                yield replace(stamped, info=info)

    def _stamped(self, recorded: Recorded) -> _Stamped | None:
        try:
            message = recorded.message()
        except RecordingError as error:
            self.notes.losses[str(error)] += 1
            return None
        stamp = message.header.stamp
        return _Stamped(stamp.sec * 1_000_000_000 + stamp.nanosec, recorded)

    def _unusable(self, reason: str) -> None:
        """Noted once, however many frames it is in force for."""
        self.notes.warnings[f"{self.topics.camera_info}: {reason}"] = 1

    def _decode(
        self,
        index: int,
        image: _Stamped,
        depth: _Stamped | None,
        infos: _Infos,
        calibrator: Calibrator,
    ) -> RecordedFrame | None:
        message = image.recorded.message()
        frame_id = str(message.header.frame_id)
        compressed = image.recorded.kind == COMPRESSED_IMAGE
        try:
            pixels = decode_compressed(message) if compressed else decode_image(message)
            view = calibrator.view(pixels, frame_id, infos.message(), self._rules)
        except MessageError as error:
            self.notes.losses[f"{image.recorded.topic}: image skipped: {error}"] += 1
            return None
        truth = self._decode_depth(depth)
        return RecordedFrame(
            index=index,
            stamp_ns=image.stamp_ns,
            frame_id=frame_id,
            image=view.image,
            camera_matrix=view.matrix,
            depth=None if truth is None else undistort_depth(truth, view),
            source=image.recorded,
            info=infos.recorded,
            visible=view.visible,
        )

    def _decode_depth(self, depth: _Stamped | None) -> np.ndarray | None:
        if depth is None:
            if self.topics.depth is not None:
                self.notes.warnings[f"{self.topics.depth}: no depth at an image's stamp"] += 1
            return None
        message = depth.recorded.message()
        compressed = depth.recorded.kind == COMPRESSED_IMAGE
        try:
            return decode_compressed_depth(message) if compressed else decode_depth(message)
        except MessageError as error:
            self.notes.losses[f"{depth.recorded.topic}: depth skipped: {error}"] += 1
            return None


@dataclass(frozen=True)
class _Stamped:
    stamp_ns: int
    recorded: Recorded
    info: Recorded | None = None


class _Infos:
    """The CameraInfo in force, deserialised once per content."""

    def __init__(self, first: Recorded | None) -> None:
        self.recorded = first
        self._known: tuple[bytes, Any] | None = None

    def message(self) -> Any:
        """None without one, or with one that cannot be read."""
        if self.recorded is None:
            return None
        content = self.recorded.data[12:]  # all but the CDR head and the stamp
        if self._known is None or self._known[0] != content:
            try:
                self._known = (content, self.recorded.message())
            except RecordingError:  # counted where it was read
                self._known = (content, None)
        return self._known[1]


def match_depth(
    events: Iterable[_Stamped], depth_topic: str, tolerance_ns: int
) -> Iterator[tuple[_Stamped, _Stamped | None]]:
    """Pair images with the depth nearest in stamp within the tolerance, in the images' order.

    An image waits until a depth at or after its stamp has come, or MAX_WAITING others wait.
    When stamps go back (a looped recording), the depths of the loop before are forgotten.
    """
    images: deque[_Stamped] = deque()
    depths: deque[_Stamped] = deque(maxlen=MAX_WAITING)
    new: deque[_Stamped] = deque(maxlen=MAX_WAITING)  # depths since the last image
    last: int | None = None

    def pair() -> tuple[_Stamped, _Stamped | None]:
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


class FolderRecording:
    """Frames of an RGB-D folder, as if they had been recorded at a fixed rate."""

    topics = Topics("rgb/", "K.txt", "depth/")

    def __init__(self, path: Path, rate: float = 10.0) -> None:
        self.path = path
        self.notes = Notes()
        self._rate = rate

    @property
    def expected_frames(self) -> int:
        """See Recording."""
        return len(numbered(self.path / "rgb", IMAGE_SUFFIXES))

    def frames(self) -> Iterator[RecordedFrame]:
        """See Recording."""
        frame_id = "camera_optical"
        for index, frame in enumerate(read_rgbd_folder(self.path, self._rate)):
            stamp_ns = round(frame.stamp * 1e9)
            image = image_message(frame.image, "rgb8", stamp_ns, frame_id)
            info = None
            if frame.camera_matrix is not None:
                size = frame.image.shape[:2]
                message = camera_info(frame.camera_matrix, size, stamp_ns, frame_id)
                info = _made("/camera/camera_info", CAMERA_INFO, message, stamp_ns)
            yield RecordedFrame(
                index=index,
                stamp_ns=stamp_ns,
                frame_id=frame_id,
                image=frame.image,
                camera_matrix=frame.camera_matrix,
                depth=frame.depth_m,
                source=_made("/camera/image", IMAGE, image, stamp_ns),
                info=info,
            )


def _made(topic: str, kind: str, message: Any, stamp_ns: int) -> Recorded:
    return Recorded(topic, kind, stamp_ns, bytes(TYPES.serialize_cdr(message, kind)))
