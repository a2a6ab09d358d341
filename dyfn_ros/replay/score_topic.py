"""A recorded topic of predictions, scored as those of a model are; no model runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dyfn_core.evaluation.sequence import SequenceEvaluation
from dyfn_core.quantities import scored_quantity
from dyfn_core.scoring.protocols import predicted, to_shape
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_folder import RgbdRecording
from dyfn_ros.replay.reader import SourceReader
from dyfn_ros.replay.results import Result, write_results
from dyfn_ros.replay.scores import push_frame
from dyfn_ros.replay.settings import Outputs, PredictionTopic, Source


def score_topic(source: Source, topic: PredictionTopic, outputs: Outputs) -> dict[str, Any]:
    """Score what some method recorded, matched and registered as ground truth is.

    Its quantity is aligned as `dyfn-eval score` aligns that of files. Images without a prediction
    cover nothing; they, and predictions that cannot be read, are noted with the recording.

    Args:
        source: Images and ground truth.
        topic: The predictions, in the same recording.
        outputs: Where scores and report go; no other file is written.

    Returns:
        The content of metrics.json.

    Raises:
        RecordingError: There is no such topic, it is the ground truth's own, it has another field
            of view than the images, or not one prediction can be used.
        OutputError: A file cannot be written.
    """
    reader = SourceReader(source)
    others = SourceReader(
        replace(
            source,
            depth_topic=topic.topic,
            depth_info_topic=None,
            depth_transform=None,
            depth_scale=None,
        ),
        topic.quantity,
    )
    name = _recorded_name(topic, reader, others)
    outputs.folder.mkdir(parents=True, exist_ok=True)
    evaluation = _evaluate(name, topic, outputs, reader, others)
    reader.require(evaluation.frames)
    options = {
        "num_tokens": None,
        "scene_cut_threshold": None,
        "threads": 0,
        "predicted": topic.quantity,
    }
    doubts = reader.doubts(evaluation.scored_frames, outputs.depth_max)
    result = Result(topic.topic, False, evaluation, None, None, options, None, doubts=doubts)
    return write_results(source, reader.recording, outputs, result)


def _recorded_name(topic: PredictionTopic, reader: SourceReader, others: SourceReader) -> str:
    """The topic as it is recorded. Raises RecordingError when its scores would say nothing."""
    name = others.recording.topics.depth
    if isinstance(others.recording, RgbdRecording) or name is None:
        raise RecordingError(
            f"{reader.recording.path}: expected a recording with a topic "
            f"{topic.topic} of predictions"
        )
    if name == reader.recording.topics.depth:
        raise RecordingError(
            f"{reader.recording.path}: {name} is the prediction and the ground truth; name another "
            'with --depth-topic, or "none" for no scores'
        )
    return name


def _evaluate(
    name: str,
    topic: PredictionTopic,
    outputs: Outputs,
    reader: SourceReader,
    others: SourceReader,
) -> SequenceEvaluation:
    quantity = scored_quantity(topic.quantity)
    evaluation = SequenceEvaluation(reader.expected, outputs.depth_max, quantity)
    found = 0
    for frame, other in zip(reader.frames(), others.frames(), strict=True):
        found += other.depth is not None
        values = _at_size(name, other.depth, frame.image)
        pair = values, predicted(values, quantity)
        push_frame(evaluation, reader, frame, pair, frame.stamp_ns * 1e-9, latency=0.0)
    notes, noted = reader.recording.notes, others.recording.notes
    notes.losses |= noted.losses
    notes.warnings |= noted.warnings
    if evaluation.frames and not found:
        reasons = "; ".join(noted.losses) or "no prediction has the stamp of an image"
        raise RecordingError(f"{reader.recording.path}: {name}: no usable prediction: {reasons}")
    return evaluation


def _at_size(name: str, prediction: np.ndarray | None, image: np.ndarray) -> np.ndarray:
    """H x W of the image; all NaN without a prediction."""
    height, width = image.shape[:2]
    if prediction is None:
        return np.full((height, width), np.nan, np.float32)
    try:
        return to_shape(prediction, (height, width))
    except ValueError:
        raise RecordingError(
            f"{name}: {prediction.shape[1]} x {prediction.shape[0]} pixels do not show the same "
            f"field of view as images of {width} x {height}"
        ) from None
