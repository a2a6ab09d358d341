"""The topics of one camera's metric scale: measurements in, the scale and what it rests on out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import sensor_msgs.msg
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64

from dyfn_core.metric.scale import ScaleInForce
from dyfn_core.stream.session import StreamSession
from dyfn_ros.messages.references import message_references
from dyfn_ros.node.odometry import TransformTopics
from dyfn_ros.node.parameters.table import NodeSettings
from dyfn_ros.node.topics import NodeTopics

_REFERENCE_DEPTH = 20


class ScaleTopics:
    """~/scale, ~/scale/status and the reference topic of one camera.

    Made on configure, before there is a model; measurements that come before `open` are not kept.
    title: of the camera in diagnostics: its name and hardware_id.
    """

    def __init__(
        self,
        ports: NodeTopics,
        prefix: str,
        title: tuple[str, str],
        settings: NodeSettings,
        transforms: TransformTopics,
    ) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._title, self._hardware_id = title
        self._scale = ports.publisher(Float64, f"~/{prefix}scale", latched)
        self._status = ports.publisher(DiagnosticStatus, f"~/{prefix}scale/status", latched)
        self._take: Callable[[Any], None] = lambda message: None
        self.topic = ""
        self._transforms = transforms.buffer
        if settings.metric_source == "reference":
            kind = getattr(sensor_msgs.msg, settings.reference_type)
            best_effort = QoSProfile(
                depth=_REFERENCE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT
            )
            subscription = ports.subscription(
                kind, f"{prefix}reference", lambda message: self._take(message), best_effort
            )
            self.topic = subscription.topic_name
            if not settings.reference_transform.strip():
                transforms.subscribe()

    def open(
        self, session: StreamSession, settings: NodeSettings, warn: Callable[[str], None]
    ) -> None:
        """Give the session what comes from now on.

        warn: takes the reason why a measurement cannot be used. Raises ValueError when the
        settings of the reference are not usable.
        """
        reference = message_references(
            settings, lambda reason: warn(f"{self.topic}: {reason}"), self._transforms
        )

        def take(message: Any) -> None:  # executor's thread
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            session.add_reference(stamp, reference(message, stamp))

        self._take = take

    def publish(self, scale: ScaleInForce, faults: Sequence[str]) -> None:
        """Both are latched and follow every frame: a number to plot, and all that is known.

        faults: why the frame has no depth at all; there are no metres then either.
        """
        known = scale.map.scale if scale.map and not faults else math.nan
        self._scale.publish(Float64(data=known))
        level = DiagnosticStatus.WARN if scale.warning else DiagnosticStatus.OK
        self._status.publish(
            DiagnosticStatus(
                level=DiagnosticStatus.ERROR if faults else level,
                name=f"{self._title}: scale",
                hardware_id=self._hardware_id,
                message="; ".join(faults)
                or scale.warning
                or ("metric" if scale.metric else "relative"),
                values=[KeyValue(key=k, value=v) for k, v in scale.described().items()],
            )
        )

    def report(self) -> dict[str, str]:
        """For diagnostics: name and value."""
        return {"scale: topic": self.topic} if self.topic else {}
