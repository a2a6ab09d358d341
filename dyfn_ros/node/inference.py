"""The frames of all cameras through one model, those that wait together in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sensor_msgs.msg import CameraInfo

from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.depth_stream import DepthStream, push_together
from dyfn_ros.messages.images import MessageError
from dyfn_ros.node.camera import FrameJob


@dataclass(frozen=True)
class _Begun:
    job: FrameJob
    frame: Frame
    info: CameraInfo | None
    stream: DepthStream


def run_jobs(jobs: Sequence[FrameJob], batch: bool) -> None:
    """One job of each camera: decode, infer, publish. What goes wrong costs that job only.

    batch: run frames of equal size and settings together.
    """
    groups: dict[Any, list[_Begun]] = {}
    for job in jobs:
        begun = _begin(job)
        if begun is not None:
            stream = begun.stream
            alike = (begun.frame.size, stream.num_tokens, stream.stabilize)
            kind: Any = alike if batch else job
            groups.setdefault(kind, []).append(begun)
    for group in groups.values():
        _run_group(group)


def _begin(job: FrameJob) -> _Begun | None:
    try:
        frame, info = job.camera.decode(job)
        return _Begun(job, frame, info, job.camera.begin(job, frame))
    except MessageError as error:
        job.camera.bad(job, error)
    except Exception as error:
        job.camera.failed(job, error)
    return None


def _run_group(group: list[_Begun]) -> None:
    try:
        predictions = _predict(group)
    except Exception as error:
        if len(group) == 1:
            group[0].job.camera.failed(group[0].job, error)
            return
        for one in group:  # the others must not pay for the one that fails
            _run_group([one])
        return
    for one, prediction in zip(group, predictions, strict=True):
        _publish(one, prediction)


def _predict(group: list[_Begun]) -> list[Prediction]:
    """Raises what the network raises; the streams are then as they were."""
    streams = [one.stream for one in group]
    memories = [stream.memory for stream in streams]
    try:
        return push_together(
            streams, [one.frame.image for one in group], [one.frame.stamp for one in group]
        )
    except Exception:
        for stream, memory in zip(streams, memories, strict=True):
            stream.memory = memory
        raise


def _publish(one: _Begun, prediction: Prediction) -> None:
    camera = one.job.camera
    try:
        found = camera.end(one.job, one.frame, prediction)
        camera.publish(one.job, one.frame, one.info, found)
    except Exception as error:
        camera.failed(one.job, error)
