"""What /diagnostics says: one status for the node and one for each camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from socket import gethostname

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from dyfn_ros.node.camera import Camera
from dyfn_ros.node.parameters.table import NodeSettings
from dyfn_ros.node.statistics import StatisticsSnapshot

_FEW = 0.01  # share of the pixels with depth; less is hardly what anybody wants
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Report:
    """What is known at one moment.

    phase: lifecycle state. callback_errors: callbacks that raised, so far.
    mismatches: incompatible QoS by topic. dropped: frames per camera. twins: what is to be said
    of other nodes of this name, or "".
    """

    name: str
    phase: str
    settings: NodeSettings
    device: str
    error: BaseException | None
    twins: str
    callback_errors: int
    mismatches: Mapping[str, str]
    cameras: Sequence[Camera]
    dropped: Sequence[int]


def node_diagnostics(report: Report) -> DiagnosticArray:
    """Without a stamp; takes a snapshot of each camera's statistics."""
    cameras = zip(report.cameras, report.dropped, strict=True)
    return DiagnosticArray(
        status=[_node(report), *(_camera(report, camera, dropped) for camera, dropped in cameras)]
    )


def _status(
    name: str,
    hardware: str,
    problems: Sequence[tuple[bytes, str]],
    fine: str,
    values: Mapping[str, str],
) -> DiagnosticStatus:
    """The worst problem's level and all problems' texts."""
    return DiagnosticStatus(
        level=max([level for level, _ in problems], default=OK),
        name=name,
        hardware_id=hardware,
        message="; ".join(text for _, text in problems) or fine,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )


def _node(report: Report) -> DiagnosticStatus:
    problems = [
        (WARN, f"{topic}: {mismatch}") for topic, mismatch in sorted(report.mismatches.items())
    ]
    if report.error is not None:
        problems.insert(0, (ERROR, f"inference has ended: {report.error!r}"))
    if report.twins:
        problems.append((WARN, report.twins))
    values = {
        "state": report.phase,
        "model": report.settings.model,
        "device": report.device,
        "stabilizer": "on" if report.settings.stabilize else "off",
        "cameras": str(len(report.cameras)),
        "failed callbacks": str(report.callback_errors),
    }
    values.update({f"incompatible QoS {t}": m for t, m in sorted(report.mismatches.items())})
    return _status(
        report.name, f"{gethostname()} {report.device}".strip(), problems, report.phase, values
    )


def _camera(report: Report, camera: Camera, dropped: int) -> DiagnosticStatus:
    snapshot = camera.statistics.snapshot()
    values = {
        "image topic": camera.image_topic,
        "input rate": f"{snapshot.input_rate:.2f} Hz",
        "output rate": f"{snapshot.output_rate:.2f} Hz",
        **_milliseconds("latency", snapshot.latency if snapshot.same_clock else None),
        **_milliseconds("processing", snapshot.processing),
        "dropped": str(dropped + snapshot.counts.get("unpublished", 0)),
    }
    for key in ("received", "published", "bad", "failed"):
        values[key] = str(snapshot.counts.get(key, 0))
    values["damaged"] = str(snapshot.counts.get("damaged", 0))
    valid = camera.statistics.valid_ratio
    values["valid ratio"] = "unknown" if valid is None else f"{valid:.3f}"
    values["device"] = camera.device
    values["lost on the way"] = str(snapshot.counts.get("lost", 0))
    values["reliability"] = "reliable" if camera.reliable else "best effort"
    values["skipped by max_rate"] = str(snapshot.counts.get("skipped", 0))
    values["received while inactive"] = str(snapshot.counts.get("inactive", 0))
    resets = camera.resets
    values["resets"] = str(sum(resets.values()))
    values.update({f"resets: {reason}": str(count) for reason, count in resets.items()})
    if camera.session is not None:
        values.update(camera.session.report())
    values.update(camera.scale_topics.report())
    values.update(camera.odometry.report())
    problems = _camera_problems(report, camera, snapshot)
    name = f"{report.name}: {camera.name or 'camera'}"
    return _status(name, camera.hardware_id, problems, report.phase, values)


def _milliseconds(name: str, seconds: tuple[float, float] | None) -> dict[str, str]:
    if seconds is None:
        return {f"{name} p50": "unknown", f"{name} p99": "unknown"}
    return {
        f"{name} {which}": f"{value * 1e3:.1f} ms"
        for which, value in zip(("p50", "p99"), seconds, strict=True)
    }


def _camera_problems(
    report: Report, camera: Camera, snapshot: StatisticsSnapshot
) -> list[tuple[bytes, str]]:
    problems = []
    if failed := snapshot.recent.get("failed"):
        problems.append((ERROR, f"inference failed on {failed} frames"))
    if bad := snapshot.recent.get("bad"):
        problems.append((ERROR, f"{bad} images on {camera.image_topic} could not be used"))
    if lost := snapshot.recent.get("lost"):
        where = f"{lost} images on {camera.image_topic} were lost on the way"
        problems.append((WARN, f"{where}: {_advice(camera)}"))
    if camera.waits_for_info and snapshot.recent.get("received"):
        problems.append((WARN, camera.waiting))
    if report.phase == "active" and not snapshot.recent.get("received"):
        problems.append((WARN, f"no images on {camera.image_topic}"))
    if not snapshot.same_clock:
        problems.append((WARN, f"stamps on {camera.image_topic} are not of this node's clock"))
    ratio = camera.statistics.valid_ratio
    if snapshot.recent.get("published") and ratio is not None and ratio < _FEW:
        problems.append((WARN, f"{ratio:.1%} of the depth is valid"))
    if camera.session is not None:
        problems += [(ERROR, f"{text}; no depth") for text in camera.session.faults()]
        problems += [(WARN, text) for text in camera.session.problems()]
    problems += [(WARN, text) for text in camera.odometry.problems()]
    return problems


def _advice(camera: Camera) -> str:
    """What helps when images are lost between publisher and node."""
    manual = "see 'Large messages' in docs/node.md"
    if camera.reliable:
        return f"the driver's queue or transport is too small, {manual}"
    return (
        "not every publisher offers reliable delivery (`ros2 topic info -v`); let the driver do "
        f"so, or give it the Fast DDS profile, {manual}"
    )
