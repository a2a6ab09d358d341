"""`dyfn-replay`: a recording through the same DepthStream as the node, and its scores."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from dyfn_core.evaluation.benchmarks.predictions import scored_quantity
from dyfn_core.evaluation.sequence import SequenceEvaluation
from dyfn_core.prediction import DEPTH, Frame
from dyfn_core.scoring.protocols import FrameScore, SequenceScorer, predicted, to_shape
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.session import StreamSession
from dyfn_core.threads import computing_threads
from dyfn_ros.recordings.open import (
    RecordedFrame,
    Recording,
    RecordingError,
    RgbdRecording,
    open_recording,
)
from dyfn_ros.replay.options import ReplayOptions
from dyfn_ros.replay.outputs import OutputOptions, ReplayOutputs
from dyfn_ros.replay.results import Result, write_results
from dyfn_ros.replay.video import Alignment

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

ALL, UNUSABLE, PARTIAL = 0, 2, 3  # exit codes; argparse also ends with 2
ModelLoader = Callable[[str, str], "GeometryModel"]


def load(name: str, device: str) -> GeometryModel:
    """load_model, imported when it is needed: torch takes seconds that --help should not."""
    from dyfn_core.models import load_model

    return load_model(name, device=device)


def replay(options: ReplayOptions, loader: ModelLoader = load) -> dict[str, Any]:
    """Replay one image topic and write everything into options.out; -> metrics.json's content.

    With a prediction_topic no model runs: its images are scored. Raises RecordingError for a
    recording that cannot be used, OutputError for a file that cannot be written, and what
    load_model raises.
    """
    recording = _open(options)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.prediction_topic is not None:
        evaluation = score_topic(options, recording)
        _require_frames(options, recording, evaluation)
        name = options.prediction_topic
        return write_results(options, Result(recording, name, False, evaluation, None, 0, None))
    model = loader(options.model, options.device)
    with computing_threads(options.threads) as threads:
        outputs = _outputs_of(options, recording)
        evaluation = _run(options, recording, model, outputs)
        _require_frames(options, recording, evaluation)
        base = _run_base(options, model) if options.compare else None
        if options.controls:
            evaluation.scores.controls |= _run_controls(options, model)
    stabilized = options.stabilizer and model.stabilizer is not None
    result = Result(recording, options.model, stabilized, evaluation, base, threads, outputs.cloud)
    return write_results(options, result)


def _require_frames(
    options: ReplayOptions, recording: Recording, evaluation: SequenceEvaluation
) -> None:
    if evaluation.frames == 0:
        reasons = "; ".join(recording.notes.losses) or "it holds no frames"
        raise RecordingError(f"{options.recording}: no frame could be used: {reasons}")


def score_topic(options: ReplayOptions, recording: Recording) -> SequenceEvaluation:
    """What some method recorded on prediction_topic, matched and registered as truth is.

    Its quantity is aligned as `dyfn-eval score` aligns that of files. Images without a prediction
    cover nothing; they, and predictions that cannot be read, are noted with the recording.
    Raises RecordingError: no such topic, the ground truth's own, another field of view than the
    images, or not one usable prediction.
    """
    other = replace(
        options, depth_topic=options.prediction_topic, depth_info_topic=None, depth_transform=None
    )
    predicted_by = _open(other, options.quantity)
    topic = _prediction_topic(options, recording, predicted_by)
    frames, expected = _frames(options, recording)
    predictions, _ = _frames(other, predicted_by)
    quantity = scored_quantity(options.quantity)
    evaluation = SequenceEvaluation(expected, options.depth_max, quantity)
    found = 0
    for frame, prediction in zip(frames, predictions, strict=True):
        found += prediction.depth is not None
        said = _at_size(topic, prediction.depth, frame.image)
        stamp, valid = frame.stamp_ns * 1e-9, predicted(said, quantity)
        _push(evaluation, recording, frame, (said, valid), stamp, latency=0.0)
    recording.notes.losses |= predicted_by.notes.losses
    recording.notes.warnings |= predicted_by.notes.warnings
    if evaluation.frames and not found:
        reasons = "; ".join(predicted_by.notes.losses) or "none has the stamp of an image"
        raise RecordingError(f"{options.recording}: {topic}: no usable prediction: {reasons}")
    return evaluation


def _prediction_topic(options: ReplayOptions, recording: Recording, predicted_by: Recording) -> str:
    """As it is recorded. Raises RecordingError when its scores would say nothing."""
    topic = predicted_by.topics.depth
    if isinstance(recording, RgbdRecording) or topic is None:
        raise RecordingError(
            f"{options.recording}: expected a recording with a topic "
            f"{options.prediction_topic} of predictions"
        )
    if topic == recording.topics.depth:
        raise RecordingError(
            f"{options.recording}: {topic} is the prediction and the ground truth; name another "
            'with --depth-topic, or "none" for no scores'
        )
    return topic


def _at_size(topic: str, said: np.ndarray | None, image: np.ndarray) -> np.ndarray:
    """H x W of the image; all NaN when nothing was said."""
    height, width = image.shape[:2]
    if said is None:
        return np.full((height, width), np.nan, np.float32)
    try:
        return to_shape(said, (height, width))
    except ValueError:
        raise RecordingError(
            f"{topic}: {said.shape[1]} x {said.shape[0]} pixels do not show the same field of "
            f"view as images of {width} x {height}"
        ) from None


def _push(
    evaluation: SequenceEvaluation,
    recording: Recording,
    frame: RecordedFrame,
    said: tuple[np.ndarray, np.ndarray],
    stamp: float,
    latency: float,
) -> FrameScore:
    try:
        return evaluation.push(frame.image, *said, frame.depth, stamp=stamp, latency=latency)
    except ValueError as error:
        raise RecordingError(f"{recording.topics.depth}: {error}") from error


def _open(options: ReplayOptions, quantity: str = DEPTH) -> Recording:
    return open_recording(
        options.recording,
        options.image_topic,
        options.camera_info_topic,
        options.depth_topic,
        options.tolerance,
        depth_info_topic=options.depth_info_topic,
        depth_transform=options.depth_transform,
        stamps=options.stamps,
        quantity=quantity,
    )


def _run_base(options: ReplayOptions, model: GeometryModel) -> SequenceEvaluation | None:
    """The same frames without DyFN, nothing but their evaluation kept; None without DyFN."""
    if not options.stabilizer or model.stabilizer is None:
        return None
    return _run(replace(options, stabilizer=False), _open(options), model)


def _run_controls(options: ReplayOptions, model: GeometryModel) -> dict[str, SequenceScorer]:
    """The same frames with each of latent_controls in DyFN's place."""
    from dyfn_core.models.controls import latent_controls, stabilized_by

    found = {}
    for name, control in latent_controls(model).items():
        with stabilized_by(model, control):
            run = _run(replace(options, stabilizer=True), _open(options), model)
        found[name] = run.scores.scorer
    return found


def _frames(options: ReplayOptions, recording: Recording) -> tuple[Iterator[RecordedFrame], int]:
    """The frames to use, and how many there will be if none is lost."""
    available = math.ceil(recording.expected_frames / options.stride)
    expected = min(available, options.max_frames or available)
    frames = islice(recording.frames(), 0, None, options.stride)
    return islice(frames, options.max_frames), expected


def _run(
    options: ReplayOptions,
    recording: Recording,
    model: GeometryModel,
    outputs: ReplayOutputs | None = None,
) -> SequenceEvaluation:
    chosen = StreamOptions(
        stabilize=options.stabilizer,
        num_tokens=options.num_tokens or 0,
        scene_cut_threshold=options.scene_cut_threshold,
    )
    session = StreamSession(model, chosen)
    frames, expected = _frames(options, recording)
    evaluation = SequenceEvaluation(expected, options.depth_max, model.quantity)
    with outputs or nullcontext():
        for frame in tqdm(
            frames, total=expected, unit="frame", file=sys.stderr, disable=not options.progress
        ):
            start = time.perf_counter()
            seconds, nanoseconds = divmod(frame.stamp_ns, 1_000_000_000)
            stamp = seconds + nanoseconds * 1e-9
            prediction = session.push(
                Frame(
                    frame.image, stamp, frame.camera_matrix, frame.visible, frame_id=frame.frame_id
                )
            )
            latency = time.perf_counter() - start
            # Disparity is aligned as such, also where its inverse is too far to be depth.
            score = _push(evaluation, recording, frame, prediction.aligned_quantity, stamp, latency)
            if outputs is not None:
                outputs.write(frame, prediction, score)
        if outputs is not None:
            video, quantity = evaluation.video(), model.quantity
            alignment = None if video is None else Alignment(video.scale, video.shift, quantity)
            outputs.finish(alignment, quantity)
    return evaluation


def _outputs_of(options: ReplayOptions, recording: Recording) -> ReplayOutputs:
    chosen = OutputOptions(options.write, options.pose_topic, options.voxel, options.depth_max)

    def warn(reason: str) -> None:
        recording.notes.warnings[reason] += 1

    return ReplayOutputs(options.out, options.recording, chosen, warn)
