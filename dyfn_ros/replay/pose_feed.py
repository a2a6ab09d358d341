"""The camera's poses of a recording, as its odometry would give them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dyfn_core.metric.odometry_noise import NoisyOdometry
from dyfn_core.metric.pose_agreement import Agreement, PoseAgreement
from dyfn_core.metric.pose_history import SECOND, Placed
from dyfn_ros.messages.odometry_options import OdometryOptions
from dyfn_ros.recordings.clocks import offset_text, side_of
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.recordings.poses import PoseTopic, open_poses
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder
from dyfn_ros.replay.settings import Source

TOLD = 0.02  # seconds: an offset is told to a tenth of it


class PoseFeed:
    """The pose of each frame, for metric_source "odometry"."""

    def __init__(self, source: Source, options: OdometryOptions, expected_frames: int) -> None:
        """Take the poses of a recording.

        Args:
            source: Which recording and topic, and the errors that are added to the poses.
            options: What the topic holds, and where the camera is.
            expected_frames: How many there will be.

        Raises:
            PoseError: It has none, or several topics may be meant.
            ValueError: An option is wrong.
        """
        noise, path = source.odometry_noise, source.recording
        self._source, self._options = source, options
        self._agreement = PoseAgreement(expected_frames)
        self._frame_id = ""
        self._noise = None if noise is None else NoisyOdometry(noise)
        self._topic: PoseTopic | None = None
        if path.is_dir() and is_rgbd_folder(path):
            self._find = _of_folder(source)
        else:
            self._topic = topic = PoseTopic(path, options, source.odometry_topic, source.stamps)
            offset = round(source.odometry_offset * SECOND)
            self._find = lambda frame: topic.at(
                frame.stamp_ns + offset, frame.frame_id, frame.source.log_ns
            )

    def look(self, frame: RecordedFrame) -> None:
        """Keep points of a frame, to compare the poses with the motion in the pictures."""
        self._frame_id = frame.frame_id
        self._agreement.push(frame.image, frame.stamp_ns, frame.camera_matrix)

    def doubts(self) -> list[str]:
        """What makes the poses implausible, a sentence each; reads them once more."""
        source = self._source
        there, name = source.odometry_offset, "poses.txt"
        if self._topic is None:
            lookup = open_poses(source.recording, "", source.odometry_topic)
            found = self._agreement.judge(lambda stamp: lookup(-1, stamp))
        else:
            name = self._topic.poses.topic
            whole = PoseTopic(
                source.recording, self._options, source.odometry_topic, source.stamps, whole=True
            )
            offset = round(there * SECOND)

            def pose_at(stamp: int) -> np.ndarray | None:
                placed = whole.poses.at(stamp + offset, self._frame_id)
                return None if placed is None else placed.pose

            found = self._agreement.judge(pose_at)
        return pose_doubts(found, name, "--odometry-offset", there)

    def pose(self, frame: RecordedFrame) -> Placed | None:
        """4 x 4, camera to world, metres, of a frame; they must come in order.

        Returns:
            None when it is not known.
        """
        found = self._find(frame)
        if self._noise is None or found is None:
            return found
        return Placed(self._noise.push(found.pose))

    def warnings(self) -> dict[str, int]:
        """What was not used or is missing, with how often."""
        return {} if self._topic is None else self._topic.poses.lines()

    def losses(self) -> dict[str, int]:
        """Messages that could not be read, with how often."""
        return {} if self._topic is None else dict(self._topic.losses)

    def facts(self) -> dict[str, str]:
        """What the poses rest on, for metrics.json."""
        return {} if self._topic is None else self._topic.poses.report()


def pose_doubts(found: Agreement | None, name: str, option: str, there: float) -> list[str]:
    """What is to be said of poses, a sentence each.

    Args:
        found: How they agree with the pictures; None when that is not known.
        name: Of their topic or file.
        option: That takes an offset away.
        there: Its value, seconds.
    """
    if found is None:
        return []
    told = []
    if found.offset is not None:
        corrected = f", less {option} {there:g}," if there else ""
        told.append(
            f"{name}: its stamps{corrected} are {offset_text(abs(found.offset), TOLD)} s "
            f"{side_of(found.offset)} those of the images, by the motion in the pictures (points "
            f"miss their epipolar lines by {found.error:.2f} px, without it by {found.best:.2f}); "
            f"{option} {offset_text(there + found.offset, TOLD)} takes that away"
        )
    if found.far:
        told.append(
            f"{name}: its poses do not agree with the motion in the pictures: points miss their "
            f"epipolar lines by {found.best:.2f} px at any offset in time, by the pictures alone "
            f"{found.alone:.2f}; of another camera or frame, with other axes, or world to camera "
            "instead of camera to world?"
        )
    return told


def _of_folder(source: Source) -> Callable[[RecordedFrame], Placed | None]:
    lookup = open_poses(source.recording, "", source.odometry_topic)

    def find(frame: RecordedFrame) -> Placed | None:
        pose = lookup(frame.index, frame.stamp_ns)
        return None if pose is None else Placed(pose)

    return find
