"""The metric scale of one camera in the node: measurements in, metres and what they rest on out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import sensor_msgs.msg
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64

from dyfn_core.stream.session import BACKWARDS, TIME_JUMP, Geometry, StreamFrame, StreamHook
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.references import parse_transform, reference_decoder
from dyfn_ros.node.parameters.table import Settings
from dyfn_ros.node.topics import NodeTopics

if TYPE_CHECKING:
    from dyfn_core.metric.calibration import ScaleCalibration
    from dyfn_core.metric.scale import ScaleInForce, ScaleOptions

_REFERENCE_DEPTH = 20


class ScalePorts:
    """~/scale, ~/scale/status and the reference topic of one camera.

    Made on configure, before there is a model; what comes before `listener` is set is not kept.
    """

    def __init__(self, ports: NodeTopics, prefix: str, title: str, settings: Settings) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._title = title
        self._scale = ports.publisher(Float64, f"~/{prefix}scale", latched)
        self._status = ports.publisher(DiagnosticStatus, f"~/{prefix}scale/status", latched)
        self.listener: Callable[[Any], None] = lambda message: None
        self.topic = ""
        if settings.metric_source == "reference":
            kind = getattr(sensor_msgs.msg, settings.reference_type)
            best_effort = QoSProfile(
                depth=_REFERENCE_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT
            )
            subscription = ports.subscription(
                kind, f"{prefix}reference", lambda message: self.listener(message), best_effort
            )
            self.topic = subscription.topic_name

    def publish(self, scale: ScaleInForce) -> None:
        """Both are latched and follow every frame: a number to plot, and all that is known."""
        self._scale.publish(Float64(data=scale.map.scale if scale.map else math.nan))
        self._status.publish(
            DiagnosticStatus(
                level=DiagnosticStatus.WARN if problem_of(scale) else DiagnosticStatus.OK,
                name=f"{self._title}: scale",
                message=problem_of(scale) or ("metric" if scale.metric else "relative"),
                values=[KeyValue(key=k, value=v) for k, v in described(scale).items()],
            )
        )


def problem_of(scale: ScaleInForce) -> str:
    """What a user who configured a source must know; "" when it does what it should."""
    if scale.source == "none":
        return ""
    return scale.problem if scale.disagrees or not scale.metric else ""


def described(scale: ScaleInForce) -> dict[str, str]:
    """Name and value of everything that is known about a scale."""
    values = {
        "unit": "metres" if scale.metric else "relative",
        "source": scale.source,
        "scale": f"{scale.map.scale:.6g}" if scale.map else "none",
    }
    if scale.map and scale.map.shift:
        values["shift"] = f"{scale.map.shift:.6g}"
    values["spread"] = "unknown" if math.isnan(scale.spread) else f"{scale.spread:.4f}"
    values["age"] = "unknown" if math.isnan(scale.age) else f"{scale.age:.3f} s"
    values["points"] = str(scale.points)
    values["disagrees"] = str(scale.disagrees).lower()
    values["recalibrations"] = str(scale.recalibrations)
    if scale.problem:
        values["problem"] = scale.problem
    return values


def scale_options(settings: Settings) -> ScaleOptions:
    """Raises ValueError that names the setting."""
    from dyfn_core.metric.calibration import CalibrationOptions
    from dyfn_core.metric.ground import up_from_pitch
    from dyfn_core.metric.scale import ScaleOptions

    up = up_from_pitch(math.radians(settings.camera_pitch))
    return ScaleOptions(
        source=settings.metric_source,
        metric_scale=settings.metric_scale,
        camera_height=settings.camera_height,
        up=(float(up[0]), float(up[1]), float(up[2])),
        calibration=CalibrationOptions(
            mode=settings.calibration,
            fit=settings.calibration_fit,
            seconds=settings.calibration_seconds,
            min_points=settings.calibration_points,
            rate=settings.tracking_rate,
            disagreement=settings.reference_disagreement,
        ),
    )


class MetricHook(StreamHook):
    """settings: the values in force, asked for at each frame. warn: for bad measurements.

    While a source is configured and has no scale yet, depth is withheld (all invalid) unless
    `until_metric` asks for relative depth: one topic must not change its unit unnoticed.
    """

    def __init__(
        self, settings: Callable[[], Settings], ports: ScalePorts, warn: Callable[[str], None]
    ) -> None:
        from dyfn_core.metric.pairing import Pairing
        from dyfn_core.metric.scale import MetricScale

        now = settings()
        self._settings, self._ports, self._warn = settings, ports, warn
        self.scale = MetricScale(scale_options(now))
        self._pairing: Pairing[Any] = Pairing(now.reference_tolerance)
        transform = parse_transform(now.reference_transform, now.reference_type)
        self._decode = reference_decoder(now.reference_type, transform)
        self._bad: Counter[str] = Counter()
        self._last: ScaleInForce = self.scale.in_force(0.0)
        ports.listener = self._on_reference

    @property
    def state(self) -> ScaleCalibration:
        """What the calibration remembers."""
        return self.scale.calibrator.state

    def restore(self, state: ScaleCalibration | None) -> None:
        """Go on from a remembered calibration; None starts anew."""
        self.scale.reset()
        if state is not None:
            self.scale.calibrator.state = state

    def _on_reference(self, message: Any) -> None:
        """Executor's thread."""
        stamp = message.header.stamp
        self._pairing.put(stamp.sec + stamp.nanosec * 1e-9, message)

    def started(self, reason: str | None) -> None:
        """A new stream has a unit of its own: calibrations end, a fixed scale stays."""
        self.scale.reset()
        if reason in (BACKWARDS, TIME_JUMP):
            self._pairing.clear()

    def after_prediction(self, frame: StreamFrame, geometry: Geometry) -> Geometry:
        """See StreamHook."""
        stamp = frame.stamp or 0.0
        settings = self._settings()
        if settings.metric_scale != self.scale.options.metric_scale:
            self.scale.options = replace(self.scale.options, metric_scale=settings.metric_scale)
        references = list(self._references(stamp))
        self._last = scale = self.scale.push(geometry, stamp, references)
        self._ports.publish(scale)
        if scale.map is None:
            withheld = scale.source != "none" and settings.until_metric == "withhold"
            nothing = np.zeros_like(geometry.valid)
            return replace(geometry, valid=nothing) if withheld else geometry
        if scale.map.shift == 0:
            return geometry.scaled(scale.map.scale)
        from dyfn_core.metric.scale import to_metres

        points, depth, before = to_metres(geometry.points, geometry.depth, scale.map)
        valid = geometry.valid & before
        return replace(geometry, points=points, depth=depth, valid=valid, metric=True)

    def _references(self, stamp: float) -> Sequence[Any]:
        """The measurements of this frame's time that can be read."""
        found = []
        for message in self._pairing.take(stamp):
            try:
                found.append(self._decode(message))
            except MessageError as error:
                self._bad["not decodable"] += 1
                self._warn(f"{self._ports.topic}: {error}")
        return found

    def problems(self) -> list[str]:
        """See StreamHook."""
        problem = problem_of(self._last)
        return [f"scale: {problem}"] if problem else []

    def report(self) -> dict[str, str]:
        """See StreamHook."""
        values = {f"scale: {key}": value for key, value in described(self._last).items()}
        dropped = self._bad + self._pairing.dropped + self.scale.calibrator.dropped
        if self._ports.topic:
            values["scale: topic"] = self._ports.topic
        values.update({f"scale: not used, {k}": str(n) for k, n in sorted(dropped.items())})
        return values
