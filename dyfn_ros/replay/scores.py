"""A frame's prediction against its ground truth, with errors that name the topic."""

from __future__ import annotations

import numpy as np

from dyfn_core.evaluation.sequence import SequenceEvaluation
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.replay.reader import SourceReader


def push_frame(
    evaluation: SequenceEvaluation,
    reader: SourceReader,
    frame: RecordedFrame,
    predicted: tuple[np.ndarray, np.ndarray],
    stamp: float,
    latency: float,
    metric: bool = False,
    steady: tuple[np.ndarray, np.ndarray] | None = None,
) -> FrameScore:
    """Score one frame.

    Args:
        evaluation: Takes the frame.
        reader: Where the frame comes from.
        frame: Its image and ground truth.
        predicted: H x W depth or disparity, and H x W bool where it is valid.
        stamp: Seconds.
        latency: Seconds that the prediction took.
        metric: Whether the prediction is in metres.
        steady: What image and video protocol score, see SequenceEvaluation.push.

    Returns:
        The frame's score under the image protocol.

    Raises:
        RecordingError: The ground truth shows another field of view than the image.
    """
    try:
        return evaluation.push(
            frame.image,
            *predicted,
            frame.depth,
            stamp=stamp,
            latency=latency,
            metric=metric,
            steady=steady,
        )
    except ValueError as error:
        raise RecordingError(f"{reader.recording.topics.depth}: {error}") from error
