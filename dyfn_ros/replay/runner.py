"""Frames through the stream session that the node runs."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.session import StreamSession
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.replay.settings import Run

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel


@dataclass(frozen=True)
class RunFrame:
    """A frame and what the stream made of it.

    Attributes:
        frame: As it was read.
        prediction: The stream's output, at the image's resolution.
        stamp: Seconds.
        latency: Seconds that the stream took.
    """

    frame: RecordedFrame
    prediction: Prediction[np.ndarray]
    stamp: float
    latency: float


def stream_frames(
    run: Run, model: GeometryModel, frames: Iterable[RecordedFrame]
) -> Iterator[RunFrame]:
    """Push frames into one stream session, one at a time.

    Args:
        run: The stream's options.
        model: As load_model returns it.
        frames: In order.

    Yields:
        Each frame with its output.
    """
    options = StreamOptions(
        stabilize=run.stabilizer,
        num_tokens=run.num_tokens or 0,
        scene_cut_threshold=run.scene_cut_threshold,
    )
    session = StreamSession(model, options)
    for frame in frames:
        start = time.perf_counter()
        seconds, nanoseconds = divmod(frame.stamp_ns, 1_000_000_000)
        stamp = seconds + nanoseconds * 1e-9
        prediction = session.push(
            Frame(frame.image, stamp, frame.camera_matrix, frame.visible, frame_id=frame.frame_id)
        )
        yield RunFrame(frame, prediction, stamp, time.perf_counter() - start)
