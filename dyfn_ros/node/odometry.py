"""The topics that say where cameras are: odometry of one camera, /tf and /tf_static of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import geometry_msgs.msg
import nav_msgs.msg
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from dyfn_core.prediction import Frame
from dyfn_ros.messages.camera_poses import CameraPoses
from dyfn_ros.messages.odometry import stamp_of
from dyfn_ros.messages.odometry_options import ODOMETRY, OdometryOptions
from dyfn_ros.messages.transforms import TransformBuffer
from dyfn_ros.node.parameters.table import NodeSettings
from dyfn_ros.node.topics import NodeTopics

_DEPTH = 200  # messages; a second of a fast odometry


class TransformTopics:
    """/tf and /tf_static, subscribed once somebody wants them, as tf2_ros does.

    Attributes:
        buffer: What they hold.
    """

    def __init__(self, ports: NodeTopics, options: OdometryOptions) -> None:
        """options: Whose limits hold for what moves."""
        self.buffer = TransformBuffer(options.pose_limits)
        self._ports = ports
        self._open = False

    def subscribe(self) -> None:
        """Once is enough. Without the package tf2_msgs the buffer's errors say so."""
        if self._open:
            return
        self._open = True
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.buffer.note = "the package tf2_msgs is not installed"
            return
        static = QoSProfile(depth=_DEPTH, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        moving = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        take = self.buffer.take
        self._ports.subscription(TFMessage, "/tf_static", lambda m: take(m, True), static)
        self._ports.follow(TFMessage, "/tf", lambda m: take(m, False), moving, True, lambda n: None)


class OdometryTopic:
    """The poses of one camera, for metric_source "odometry"; without that source, nothing.

    Made on configure; what comes before `open` is not kept.
    """

    def __init__(
        self,
        ports: NodeTopics,
        prefix: str,
        settings: NodeSettings,
        transforms: TransformTopics,
    ) -> None:
        self.poses: CameraPoses | None = None
        self._transforms = transforms
        self._wanted = settings.metric_source == "odometry"
        self._topic, self._lost = "", 0
        kind = settings.odometry_type
        package = nav_msgs.msg if kind == ODOMETRY else geometry_msgs.msg
        if self._wanted and hasattr(package, kind):
            qos = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
            self._topic = ports.follow(
                getattr(package, kind), f"{prefix}odometry", self._take, qos, True, self._count_lost
            ).topic
        if self._wanted and (not settings.camera_pose or not self._topic):
            transforms.subscribe()

    def open(self, settings: NodeSettings, warn: Callable[[str], None]) -> None:
        """Take what comes from now on.

        warn: takes a sentence for what costs poses. Raises ValueError when the settings of the
        odometry are not usable.
        """
        if not self._wanted:
            return
        self.poses = CameraPoses(settings, self._topic, self._transforms.buffer, warn)

    def _take(self, message: Any) -> None:  # executor's thread
        if self.poses is not None:
            self.poses.take(message)

    def _count_lost(self, number: int) -> None:
        self._lost += number

    # Inference thread.

    def placed(self, frame: Frame, header: Any, until: float) -> Frame:
        """A frame with the camera's pose, if that is known.

        header: the image's, with its whole stamp. until: time.monotonic() at which to stop waiting.
        """
        if self.poses is None:
            return frame
        stamp = stamp_of(header)
        self.poses.wait(stamp, frame.frame_id, until)
        found = self.poses.at(stamp, frame.frame_id)
        if found is None:
            return frame
        return replace(frame, pose=found.pose, pose_variance=found.variance)

    def report(self) -> dict[str, str]:
        """For diagnostics: name and value."""
        if self.poses is None:
            return {}
        found = self.poses.report() | {"lost by the middleware": str(self._lost)}
        return {f"odometry: {name}": value for name, value in found.items()}

    def problems(self) -> list[str]:
        """What a user should look at."""
        return [] if self.poses is None else self.poses.problems()
