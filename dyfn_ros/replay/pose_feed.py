"""The camera's poses of a recording, as its odometry would give them."""

from __future__ import annotations

from collections.abc import Callable

from dyfn_core.metric.odometry_noise import NoisyOdometry
from dyfn_core.metric.pose_history import Placed
from dyfn_ros.messages.odometry_options import OdometryOptions
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.recordings.poses import PoseTopic, open_poses
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder
from dyfn_ros.replay.settings import Source


class PoseFeed:
    """The pose of each frame, for metric_source "odometry"."""

    def __init__(self, source: Source, options: OdometryOptions) -> None:
        """Take the poses of a recording.

        Args:
            source: Which recording and topic, and the errors that are added to the poses.
            options: What the topic holds, and where the camera is.

        Raises:
            PoseError: It has none, or several topics may be meant.
            ValueError: An option is wrong.
        """
        noise, path = source.odometry_noise, source.recording
        self._noise = None if noise is None else NoisyOdometry(noise)
        self._topic: PoseTopic | None = None
        if path.is_dir() and is_rgbd_folder(path):
            self._find = _of_folder(source)
        else:
            self._topic = topic = PoseTopic(path, options, source.odometry_topic, source.stamps)
            self._find = lambda frame: topic.at(frame.stamp_ns, frame.frame_id, frame.source.log_ns)

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


def _of_folder(source: Source) -> Callable[[RecordedFrame], Placed | None]:
    lookup = open_poses(source.recording, "", source.odometry_topic)

    def find(frame: RecordedFrame) -> Placed | None:
        pose = lookup(frame.index, frame.stamp_ns)
        return None if pose is None else Placed(pose)

    return find
