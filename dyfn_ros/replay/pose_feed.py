"""The camera's poses of a recording, as its odometry would give them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dyfn_core.metric.odometry_noise import NoisyOdometry, OdometryNoise
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.recordings.poses import PoseLookup, open_poses


class PoseFeed:
    """The pose of each frame, for metric_source "odometry"."""

    def __init__(self, recording: Path, topic: str | None, noise: OdometryNoise | None) -> None:
        """Take the poses of a recording.

        Args:
            recording: Holds them.
            topic: See recordings.poses.open_poses.
            noise: Errors that are added to them; None: none.
        """
        self._recording, self._topic = recording, topic
        self._noise = None if noise is None else NoisyOdometry(noise)
        self._poses: PoseLookup | None = None

    def pose(self, frame: RecordedFrame) -> np.ndarray | None:
        """4 x 4, camera to world, metres, of a frame; they must come in order.

        Returns:
            None when it is not known.

        Raises:
            PoseError: There are no poses, or not those of this camera.
        """
        if self._poses is None:  # the first frame knows the camera's frame_id
            self._poses = open_poses(self._recording, frame.frame_id, self._topic)
        pose = self._poses(frame.index, frame.stamp_ns)
        return pose if self._noise is None or pose is None else self._noise.push(pose)
