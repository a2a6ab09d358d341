"""Where the camera was: poses out of a recording's pose, odometry and TF topics."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from dyfn_core.metric.pose_history import SECOND, Placed
from dyfn_core.metric.pose_limits import PoseLimits
from dyfn_ros.messages.camera_poses import CameraPoses
from dyfn_ros.messages.odometry_options import KINDS, ODOMETRY, TF, OdometryOptions
from dyfn_ros.messages.transforms import TransformBuffer, TransformError
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.image_recording import is_image_recording
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder, read_poses
from dyfn_ros.recordings.storage.base import Recorded, Storage
from dyfn_ros.recordings.storage.open import open_storage
from dyfn_ros.recordings.topics import NONE
from dyfn_ros.recordings.transform_topics import STATIC
from dyfn_ros.recordings.typestore import TF as TF_MESSAGE

# Of a whole recording that is read at once: nothing is dropped, and no step is too fast.
_EVERYTHING = PoseLimits(speed=math.inf, turn=math.inf, back=math.inf, capacity=None)

_TYPES = {kind: f"geometry_msgs/msg/{kind}" for kind in KINDS}
_TYPES |= {ODOMETRY: f"nav_msgs/msg/{ODOMETRY}", TF: TF_MESSAGE}

# Takes a frame's index and stamp in ns, gives its pose, 4 x 4 camera to world, or None.
PoseLookup = Callable[[int, int], "np.ndarray | None"]


class PoseError(RecordingError):
    """There are no usable poses; the message says why."""


def open_poses(
    path: Path,
    frame_id: str,
    topic: str | None = None,
    stamps: Literal["header", "log"] = "header",
) -> PoseLookup:
    """Where the camera with this frame_id was when a frame of the recording was taken.

    The whole recording is read at once; PoseTopic reads it as a robot would have met it.

    topic: PoseStamped or PoseWithCovarianceStamped (of the optical frame), Odometry or
    TransformStamped (their child frame must be the camera or be tied to it by TF), or TFMessage;
    None: TF when it leads from the camera to a root through something that moves, else the only
    pose or odometry topic. "none" does without. stamps: times of the headers, or of the log. An
    RGB-D folder has its own. Raises PoseError: no
    poses, several candidates (listed), a topic that is absent or of another type.
    """
    if topic == NONE:
        raise PoseError("poses were not wanted")
    if path.is_dir() and is_rgbd_folder(path):
        poses = read_poses(path)
        if not poses:
            raise PoseError(f"{path} holds no poses.txt or groundtruth.txt of its frames")
        return lambda index, stamp_ns: poses.get(stamp_ns)
    if is_image_recording(path):
        raise PoseError(f"{path} holds pictures, and no pose or odometry topic")
    storage = open_storage(path)
    kinds = _kinds(storage)
    transforms = TransformBuffer(_EVERYTHING)
    for recorded in storage.messages([name for name, kind in kinds.items() if kind == TF]):
        stamp = recorded.log_ns if stamps == "log" else None
        transforms.take(recorded.message(), recorded.topic.endswith(STATIC), stamp)
    if topic is not None and topic not in kinds:
        raise PoseError(f"{path}: no topic {topic} of poses, odometry or TF: {_listing(kinds)}")
    found = _by_transforms(path, frame_id, topic, kinds, transforms)
    if found is None:
        name = topic or _only(path, kinds)
        found = _by_topic(path, storage, name, kinds, transforms, stamps == "log")
        _check_tied(found, frame_id)

    def lookup(index: int, stamp_ns: int) -> np.ndarray | None:
        placed = found.at(stamp_ns, frame_id)
        return None if placed is None else placed.pose

    return lookup


def _by_transforms(
    path: Path,
    frame_id: str,
    topic: str | None,
    kinds: dict[str, str],
    transforms: TransformBuffer,
) -> CameraPoses | None:
    """The camera in the root of its tree, when it moves there, and no other topic is named."""
    if topic is not None and kinds[topic] != TF:
        return None
    frame = frame_id.lstrip("/")
    try:
        root = transforms.root(frame)
        moves = root != frame and transforms.moves(root, frame)
    except TransformError as error:
        raise PoseError(f"{path}: {error}") from error
    if moves:
        options = OdometryOptions(odometry_type=TF, odom_frame=root)
        return CameraPoses(options, "/tf", transforms, _quiet)
    if topic is not None:
        raise PoseError(f"{path}: {topic} does not say where {frame_id!r} moves")
    return None


def _by_topic(
    path: Path,
    storage: Storage,
    topic: str,
    kinds: dict[str, str],
    transforms: TransformBuffer,
    log_time: bool,
) -> CameraPoses:
    options = OdometryOptions(odometry_type=kinds[topic])
    poses = CameraPoses(options, topic, transforms, _quiet, _EVERYTHING)
    for recorded in storage.messages([topic]):
        poses.take(recorded.message(), recorded.log_ns if log_time else None)
    if not poses.taken:
        raise PoseError(f"{path}: {'; '.join(poses.lines()) or f'{topic} holds no pose'}")
    return poses


def _check_tied(poses: CameraPoses, frame_id: str) -> None:
    if problem := poses.untied(frame_id):
        raise PoseError(problem)


def _quiet(text: str) -> None:
    """What costs a cloud one frame is counted by its writer."""


def _kinds(storage: Storage) -> dict[str, str]:
    """The topics that hold poses or transforms: one of KINDS, or TF."""
    short = {full: kind for kind, full in _TYPES.items()}
    held = {name: topic.kind for name, topic in storage.topics.items() if topic.count}
    return {name: short[full] for name, full in held.items() if full in short}


def _only(path: Path, kinds: dict[str, str], option: str = "--pose-topic") -> str:
    candidates = {name: kind for name, kind in kinds.items() if kind != TF}
    if len(candidates) != 1:
        problem = f"several topics may be the pose; choose one with {option}"
        problem = problem if candidates else "no pose or odometry topic, and no TF to the camera"
        raise PoseError(f"{path}: {problem}: {_listing(candidates or kinds)}")
    return next(iter(candidates))


def _listing(kinds: dict[str, str]) -> str:
    named = (f"{name} ({_TYPES[kind]})" for name, kind in sorted(kinds.items()))
    return ", ".join(named) or "it has none"


class PoseTopic:
    """A recording's odometry and transforms, read in the order of recording as frames are met.

    Static transforms count from the start, since the live topic is latched. A frame waits for
    what was recorded up to `odometry_wait` seconds after it.

    Attributes:
        poses: Of the camera, with what was not used.
        losses: Messages that could not be read, each reason with its count.
    """

    def __init__(
        self,
        path: Path,
        options: OdometryOptions,
        topic: str | None = None,
        stamps: Literal["header", "log"] = "header",
        whole: bool = False,
    ) -> None:
        """Open the topics.

        Args:
            path: A recording of ROS messages.
            options: Frames, and the type that is looked for.
            topic: Of one of the types of OdometryOptions.odometry_type, or TFMessage; None: the
                only one of that type, else the only one of any, else /tf.
            stamps: Times of the headers, or of the log.
            whole: Everything is read at once, and no pose is dropped for its speed or age.

        Raises:
            PoseError: There is no such topic, or there are several.
            ValueError: An option is wrong.
        """
        storage = open_storage(path)
        kinds = _kinds(storage)
        name, kind = _chosen(path, kinds, options, topic)
        options = replace(options, odometry_type=kind)
        self.losses: Counter[str] = Counter()
        limits = _EVERYTHING if whole else options.pose_limits
        self.poses = CameraPoses(options, name, TransformBuffer(limits), _quiet, limits)
        self._name, self._log_time = name, stamps == "log"
        self._wait = round(options.odometry_wait * SECOND)
        tf = [found for found, kind in kinds.items() if kind == TF]
        if self.poses.wants_transforms:
            for recorded in storage.messages([one for one in tf if one.endswith(STATIC)]):
                self._take(recorded)
        moving = {one for one in tf if not one.endswith(STATIC)}
        wanted = ({name} - set(tf)) | (moving if self.poses.wants_transforms else set())
        self._messages = storage.messages(wanted)
        self._next: Recorded | None = next(self._messages, None)
        while whole and self._next is not None:
            self._step()

    def at(self, stamp: int, frame_id: str, log: int) -> Placed | None:
        """The camera's pose at a frame; frames must come in order.

        Args:
            stamp: Nanoseconds, of the frame.
            frame_id: The camera's frame.
            log: Nanoseconds, when the frame was recorded.

        Returns:
            None when it is not known; `poses` then says why.
        """
        self._read(log)
        while not self.poses.reaches(stamp, frame_id) and self._is_before(log + self._wait):
            self._step()
        return self.poses.at(stamp, frame_id)

    def _read(self, log: int) -> None:
        while self._is_before(log):
            self._step()

    def _is_before(self, log: int) -> bool:
        return self._next is not None and self._next.log_ns <= log

    def _step(self) -> None:
        assert self._next is not None
        recorded, self._next = self._next, next(self._messages, None)
        self._take(recorded)

    def _take(self, recorded: Recorded) -> None:
        try:
            message = recorded.message()
        except RecordingError as error:
            self.losses[str(error)] += 1
            return
        stamp = recorded.log_ns if self._log_time else None
        if recorded.topic == self._name and self.poses.has_topic:
            self.poses.take(message, stamp)
        else:
            self.poses.transforms.take(message, recorded.topic.endswith(STATIC), stamp)


def _chosen(
    path: Path, kinds: dict[str, str], options: OdometryOptions, topic: str | None
) -> tuple[str, str]:
    """Name and kind of the topic of poses."""
    if topic is not None:
        if topic not in kinds:
            text = f"{path}: no topic {topic} of poses, odometry or TF: {_listing(kinds)}"
            raise PoseError(text)
        return topic, kinds[topic]
    alike = {name: kind for name, kind in kinds.items() if kind == options.odometry_type}
    others = {name: kind for name, kind in kinds.items() if kind != TF}
    if options.odometry_type == TF or not others:
        if not any(kind == TF for kind in kinds.values()):
            raise PoseError(
                f"{path}: metric_source is 'odometry', expected a topic of poses, odometry or TF: "
                f"{_listing(kinds)}"
            )
        return "/tf", TF
    name = _only(path, alike or others, "--odometry-topic")
    return name, kinds[name]
