"""One recording through a model: frames are read, run, scored and written."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from dyfn_core.evaluation.sequence import SequenceEvaluation
from dyfn_core.models.controls import latent_controls, stabilized_by
from dyfn_core.models.export.backends import on_backend
from dyfn_core.prediction import Prediction
from dyfn_core.quantities import scored_quantity
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_core.threads import computing_threads
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.replay.outputs import ReplayOutputs
from dyfn_ros.replay.pipeline import Behind, ahead
from dyfn_ros.replay.reader import SourceReader
from dyfn_ros.replay.results import Result, write_results
from dyfn_ros.replay.runner import RunFrame, StreamRunner
from dyfn_ros.replay.scores import push_frame
from dyfn_ros.replay.settings import Outputs, Run, Source
from dyfn_ros.replay.shown_run import Alignment, ShownRun

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

Write = Callable[[RecordedFrame, "Prediction[np.ndarray]", FrameScore], None]
ModelLoader = Callable[[str, str], "GeometryModel"]  # name, device


def load(name: str, device: str) -> GeometryModel:
    """Load a model by bundled name, checkpoint file or Hub id."""
    from dyfn_core.models import load_model

    return load_model(name, device=device)


def replay(
    source: Source, run: Run, outputs: Outputs, loader: ModelLoader = load
) -> dict[str, Any]:
    """Replay one image topic and write everything into outputs.folder.

    Args:
        source: What to read.
        run: What to run over it.
        outputs: What to write.
        loader: Gives the model for run.model and run.device.

    Returns:
        The content of metrics.json.

    Raises:
        RecordingError: The recording cannot be used.
        OutputError: A file cannot be written.
        ValueError: An option is wrong; or whatever else `loader` raises.
    """
    reader = SourceReader(source)
    outputs.folder.mkdir(parents=True, exist_ok=True)
    model = on_backend(loader(run.model, run.device), run.backend)
    stabilized = run.stream.stabilize and model.stabilizer is not None
    with computing_threads(run.threads) as threads:
        runner = _runner(reader, run, model)
        files = ReplayOutputs(
            outputs, source.recording, reader.expected, reader.warn, source.stamps
        )
        base, alone = None, None
        plain = run.without_odometry()
        compared = run.compare and (stabilized or plain is not None)
        with files:
            evaluation = _evaluate(reader, runner, model, outputs, files.write)
            reader.require(evaluation.frames)
            name = "with DyFN" if stabilized else "base model"
            name += "" if plain is None else " and odometry"
            runs = [_shown(name, evaluation, runner.metres_per_unit)]
            if compared:
                base = _variant(source, run.without_dyfn(), model, outputs, files)
                runs.append(_shown("base model", base, None))
            files.finish(runs)
        runner.finish()
        if compared and stabilized and plain is not None:
            alone = _variant(source, plain, model, outputs)
        if run.compare and not compared:
            reader.warn(f"--compare: {run.model} ran without DyFN, there is nothing to compare")
        if run.controls:
            evaluation.controls |= _controls(source, run, model, outputs)
    if run.load_state and (base is not None or run.controls):
        reader.warn("--load-state: base model and controls started without the saved state")
    options = {**stream_facts(run), "backend": model.backend, "threads": threads}
    facts = runner.facts()
    doubts = reader.doubts(evaluation.scored_frames, outputs.depth_max)
    doubts += [*runner.doubts(), *files.doubts]
    result = Result(
        run.model, stabilized, evaluation, base, alone, options, files.cloud, facts, doubts
    )
    return write_results(source, reader.recording, outputs, result)


def stream_facts(run: Run) -> dict[str, Any]:
    """What the `options` of metrics.json have of a run; null where the model or nothing decides."""
    options = asdict(run.stream)
    del options["stabilize"]  # a key of its own
    return {
        **options,
        "num_tokens": run.stream.num_tokens or None,
        "state_file": run.stream.state_file or None,
        "reference_transform": run.stream.reference_transform or None,
        "moving_frame": run.stream.moving_frame or None,
        "camera_pose": run.stream.camera_pose or None,
        "device": run.device,
    }


def _runner(reader: SourceReader, run: Run, model: GeometryModel) -> StreamRunner:
    return StreamRunner(run, model, reader.references(run.stream), reader.poses(run.stream))


def _evaluate(
    reader: SourceReader,
    runner: StreamRunner,
    model: GeometryModel,
    outputs: Outputs,
    write: Write,
) -> SequenceEvaluation:
    """Every frame read, run and scored; `write` takes it too.

    One thread reads ahead of the model and one scores and writes behind it, in the frames' order.
    """
    evaluation = SequenceEvaluation(
        reader.expected, outputs.depth_max, scored_quantity(model.quantity)
    )

    def finish(one: RunFrame) -> None:
        score = push_frame(
            evaluation,
            reader,
            one.frame,
            _output(one.prediction),
            one.stamp,
            one.latency,
            one.prediction.metric,
            None if one.prediction.steady else one.prediction.aligned_quantity,
        )
        write(one.frame, one.prediction, score)

    with closing(ahead(reader.every())) as read, Behind(finish) as behind:
        frames = tqdm(
            _used(read, runner),
            total=reader.expected,
            unit="frame",
            file=sys.stderr,
            disable=not outputs.progress,
        )
        for one in runner.frames(frames):
            behind.push(one)
    for loss, count in runner.losses().items():
        reader.recording.notes.losses[loss] += count
    for warning, count in runner.warnings().items():
        reader.warn(warning, count)
    return evaluation


def _used(
    frames: Iterable[tuple[RecordedFrame, bool]], runner: StreamRunner
) -> Iterator[RecordedFrame]:
    """The frames that are run; the runner is told the others, in their place."""
    for frame, used in frames:
        if used:
            yield frame
        else:
            runner.skip(frame)


def _output(prediction: Prediction[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """What goes out, H x W, and where. Disparity stays disparity: its inverse may be too far."""
    if prediction.disparity is not None:
        return prediction.aligned_quantity
    return prediction.depth, prediction.valid


def _shown(name: str, evaluation: SequenceEvaluation, metres_per_unit: float | None) -> ShownRun:
    ratios = evaluation.column("video_ratio")
    return ShownRun(name, _alignment(evaluation, metres_per_unit), ratios)


def _alignment(evaluation: SequenceEvaluation, metres_per_unit: float | None) -> Alignment:
    """What brings all frames into metres: the truth's alignment, else their own scale."""
    video = evaluation.video()
    if video is not None:
        return Alignment(video.scale, video.shift, evaluation.quantity, metres=True)
    unaligned = Alignment(quantity=evaluation.quantity)
    if metres_per_unit is None or not evaluation.metric_frames:
        return unaligned
    steady = metres_per_unit != 1.0 or evaluation.metric_frames == evaluation.frames
    return Alignment(metres_per_unit, metres=True) if steady else unaligned


def _variant(
    source: Source,
    run: Run,
    model: GeometryModel,
    outputs: Outputs,
    files: ReplayOutputs | None = None,
) -> SequenceEvaluation:
    """The same frames in another run; its evaluation is kept, and its depth in files."""
    reader = SourceReader(source)
    runner = _runner(reader, run, model)

    def write(_: RecordedFrame, prediction: Prediction[np.ndarray], __: FrameScore) -> None:
        if files is not None:
            files.write_base(prediction)

    return _evaluate(reader, runner, model, outputs, write)


def _controls(
    source: Source, run: Run, model: GeometryModel, outputs: Outputs
) -> dict[str, SequenceScorer]:
    """The same frames with each of latent_controls in DyFN's place."""
    found = {}
    for name, control in latent_controls(model).items():
        with stabilized_by(model, control):
            evaluation = _variant(source, run.with_dyfn(), model, outputs)
        found[name] = evaluation.scorer
    return found
