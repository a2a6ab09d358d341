"""A source through the stream session into files and a viewer."""

from __future__ import annotations

import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from dyfn_core.models.export.backends import on_backend
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.session import StreamSession
from dyfn_core.threads import computing_threads
from dyfn_ros.depth.camera import KnownCamera
from dyfn_ros.depth.live import Open, open_capture
from dyfn_ros.depth.outputs import DepthOutputs
from dyfn_ros.depth.settings import DepthJob
from dyfn_ros.depth.source import DepthSource, SourceFrame, open_source
from dyfn_ros.recordings.errors import RecordingError

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

ModelLoader = Callable[[str, str], "GeometryModel"]  # name, device
Watch = Callable[[SourceFrame, Prediction[np.ndarray]], None]


class Stop:
    """Whether the user pressed Ctrl-C (or the process got SIGTERM): the run ends with its frame.

    A second one ends the process at once.
    """

    def __init__(self) -> None:
        self.asked = False

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Take the signals, within this process's main thread."""
        kinds = (signal.SIGINT, signal.SIGTERM)
        former = {kind: signal.signal(kind, self._take) for kind in kinds}
        try:
            yield
        finally:
            for kind, handler in former.items():
                signal.signal(kind, handler)

    def _take(self, *_: object) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True

    def __call__(self) -> bool:
        """Whether it is asked for."""
        return self.asked


@dataclass
class Outcome:
    """What came of a run.

    Attributes:
        frames: How many went through.
        seconds: That they took together, with reading and writing.
        written: Files and folders.
        losses: What could not be read, with how often.
        warnings: What a user should look at, with how often.
        notes: Facts worth a line.
        interrupted: Whether Ctrl-C came before the end of a file or folder.
    """

    frames: int
    seconds: float
    written: list[str] = field(default_factory=list)
    losses: Counter[str] = field(default_factory=Counter)
    warnings: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    interrupted: bool = False


def run(
    job: DepthJob,
    loader: ModelLoader,
    stop: Stop,
    capture: Open = open_capture,
    watch: Watch | None = None,
) -> Outcome:
    """Read, run and write.

    Args:
        job: What to do.
        loader: Gives the model.
        stop: Asked before every frame.
        capture: Opens cameras and addresses.
        watch: Is shown every frame with its depth, in order.

    Raises:
        RecordingError: The source cannot be used.
        OutputError: A file cannot be written.
        ValueError: An option is wrong; or whatever else `loader` raises.
    """
    camera = KnownCamera(job.camera)
    source = open_source(job.reading, stop, capture)
    try:
        outputs = DepthOutputs(job.writing, source)
        _require_frame(source)
        model = on_backend(loader(job.model, job.device), job.backend)
        session = StreamSession(model, job.stream)
        with computing_threads(job.threads), outputs:
            outcome = _frames(source, camera, session, outputs, stop, watch)
            outputs.finish(_facts(job, session, camera, outcome))
    finally:
        if source.live is not None:
            source.live.close()
    outcome.written = [str(path) for path in outputs.written]
    outcome.warnings += outputs.warnings
    return outcome


def _require_frame(source: DepthSource) -> None:
    """Read the first frame, before a model is loaded. Raises RecordingError without one."""
    first = next(source.frames, None)
    if first is None:
        ended = [] if source.live is None else [source.live.ended]
        reasons = "; ".join([*source.losses, *ended]) or "it holds no frame"
        raise RecordingError(f"{source.name}: no frame could be used: {reasons}")
    source.frames = chain([first], source.frames)


def _frames(
    source: DepthSource,
    camera: KnownCamera,
    session: StreamSession,
    outputs: DepthOutputs,
    stop: Stop,
    watch: Watch | None,
) -> Outcome:
    start, frames, withheld, metric = time.perf_counter(), 0, 0, 0
    origins: Counter[str] = Counter()

    def look(frame: SourceFrame) -> None:
        with suppress(RecordingError):  # it is not worked on
            session.skip(Frame(camera.apply(frame)[0], frame.stamp))

    source.between = look
    bar = tqdm(source.frames, total=source.expected, unit="frame", file=sys.stderr)
    with bar:
        for frame in bar:
            image, matrix, visible = camera.apply(frame)
            origins[camera.origin] += 1
            pushed = Frame(image, frame.stamp, matrix, visible)
            prediction = session.push(pushed)
            withheld += prediction.withheld is not None
            metric += prediction.metric
            seen = replace(frame, image=image)
            outputs.write(seen, prediction)
            if watch is not None:
                watch(seen, prediction)
            frames += 1
            if stop():
                break
    outcome = Outcome(frames, time.perf_counter() - start, losses=source.losses)
    outcome.warnings.update(dict.fromkeys(session.problems(), 1))
    if withheld:
        outcome.warnings["frames without depth, as their metres are not known yet"] += withheld
    outcome.notes.append(f"depth: {_unit(frames, metric)}")
    _note(outcome, source, origins, session)
    unread = source.expected is None or frames < source.expected
    outcome.interrupted = stop() and source.live is None and unread
    return outcome


def _unit(frames: int, metric: int) -> str:
    if metric == 0:
        return "right up to one scale, not in metres"
    return "in metres" if metric == frames else f"in metres in {metric} of {frames} frames"


def _note(
    outcome: Outcome, source: DepthSource, origins: Counter[str], session: StreamSession
) -> None:
    told = [name if len(origins) == 1 else f"{name} ({n})" for name, n in origins.items()]
    outcome.notes.append(f"camera: {', '.join(told[:3])}{', ...' if len(told) > 3 else ''}")
    resets = [f"{reason} ({count})" for reason, count in session.resets.items()]
    if resets:
        outcome.notes.append(f"the stream started anew: {', '.join(resets)}")
    live = source.live
    if live is not None and live.ended:
        outcome.losses[live.ended] += 1
    if live is not None and live.dropped:
        outcome.notes.append(f"{live.dropped} frames came while another was worked on")


def _facts(
    job: DepthJob, session: StreamSession, camera: KnownCamera, outcome: Outcome
) -> dict[str, Any]:
    """What the JSON beside files of single frames has."""
    facts: dict[str, Any] = {
        "source": job.reading.source,
        "model": job.model,
        "stabilize": session.options.stabilize and session.model.stabilizer is not None,
        "camera": camera.origin,
        "resets": dict(session.resets),
    }
    if job.stream.metric_source != "none":
        facts["metric_scale"] = session.scale.described()
    return {**facts, "losses": dict(outcome.losses)}
