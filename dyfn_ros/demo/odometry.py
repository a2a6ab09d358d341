"""The odometry of a recording, ready to be published beside its images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dyfn_core.metric.pose_history import NoPose
from dyfn_core.metric.pose_limits import PoseLimits
from dyfn_ros.messages.odometry import frame_name, stamp_of
from dyfn_ros.messages.transforms import TransformError
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.image_recording import is_image_recording
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder
from dyfn_ros.recordings.storage.open import open_storage
from dyfn_ros.recordings.transform_topics import TransformFeed
from dyfn_ros.recordings.typestore import ODOMETRY


@dataclass(frozen=True)
class RecordedOdometry:
    """The messages of one odometry topic, serialised, and where the camera is.

    Attributes:
        topic: Name of the odometry's topic.
        messages: Stamp in nanoseconds and CDR bytes, in the order of the recording.
        camera_pose: The node's parameter: the camera in the odometry's moving frame.
    """

    topic: str
    messages: tuple[tuple[int, bytes], ...]
    camera_pose: str

    def feed(self) -> OdometryFeed:
        """A feed from the first message on."""
        return OdometryFeed(self)


class OdometryFeed:
    """Gives each message once, as the images need them."""

    def __init__(self, odometry: RecordedOdometry) -> None:
        self._messages = iter(odometry.messages)
        self._reached = -1

    def until(self, stamp_ns: int) -> Iterator[bytes]:
        """The messages that are still to come up to the first one at or after a moment."""
        while self._reached < stamp_ns:
            found = next(self._messages, None)
            if found is None:
                return
            self._reached = found[0]
            yield found[1]


def read_odometry(path: Path, frame_id: str) -> tuple[RecordedOdometry | None, str]:
    """The only odometry topic (nav_msgs/Odometry) of a recording.

    Args:
        path: The recording.
        frame_id: The camera's frame.

    Returns:
        It, or None; and why there is none, "" when there is one.
    """
    if path.is_dir() and is_rgbd_folder(path):
        return None, f"{path} is an RGB-D folder, which holds no odometry topic"
    if is_image_recording(path):
        return None, f"{path} holds pictures, and no odometry topic"
    storage = open_storage(path)
    topics = sorted(n for n, t in storage.topics.items() if t.kind == ODOMETRY and t.count)
    if len(topics) != 1:
        several = f"{path} has several odometry topics: {', '.join(topics)}"
        return None, several if topics else f"{path} has no topic of nav_msgs/Odometry"
    messages, moving = [], frame_id
    for recorded in storage.messages(topics):
        message = recorded.message()
        messages.append((stamp_of(message.header), bytes(recorded.data)))
        moving = frame_name(message.child_frame_id)
    try:
        pose = _mounting(path, moving, frame_name(frame_id))
    except TransformError as error:
        return None, f"{path}: {topics[0]} is of {moving!r}, the camera is {frame_id!r}: {error}"
    rotation = Rotation.from_matrix(pose[:3, :3]).as_quat()
    text = " ".join(f"{value:.9f}" for value in (*pose[:3, 3], *rotation))
    return RecordedOdometry(topics[0], tuple(messages), text), ""


def _mounting(path: Path, moving: str, camera: str) -> np.ndarray:
    """4 x 4, by the transforms that hold for ever."""
    if moving == camera:
        return np.eye(4)
    feed = TransformFeed(path, PoseLimits())
    for reason in feed.losses:
        raise RecordingError(reason)
    found = feed.buffer.lookup(moving, camera, 0)
    if isinstance(found, NoPose):
        raise TransformError(found.detail)
    return found.pose
