"""A replay as a job: which there are, how one is run, and how it ended."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from dyfn_core.stream.saving import path_for
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.open import image_topics
from dyfn_ros.replay.run import ModelLoader, replay
from dyfn_ros.replay.score_topic import score_topic
from dyfn_ros.replay.settings import PredictionTopic, ReplayJob, Run, TopicChoice

ALL, CRASHED, UNUSABLE, PARTIAL = 0, 1, 2, 3  # exit codes; argparse also ends with 2
EXPECTED_ERRORS = (RecordingError, ValueError, OSError)  # of input, options and disk


@dataclass(frozen=True)
class BatchJob:
    """One job of several.

    Attributes:
        name: Of its folder and of its row in the summary.
        job: What is replayed.
        key: Hash of all that decides the result.
    """

    name: str
    job: ReplayJob
    key: str


@dataclass(frozen=True)
class Outcome:
    """How a job ended.

    Attributes:
        code: The exit code that dyfn-replay gives for it alone; CRASHED when its worker died, or
            it failed in a way that is our fault.
        reason: What is not whole; "" for nothing.
        traceback: Of an exception that is our fault.
    """

    code: int
    reason: str = ""
    traceback: str = ""


# Runs jobs and gives each with its outcome, in any order.
Runner = Callable[[Sequence[BatchJob], ModelLoader], Iterator[tuple[BatchJob, Outcome]]]


def run_job(job: ReplayJob, loader: ModelLoader) -> dict[str, Any]:
    """Run a job; see run.replay and score_topic.score_topic for result and exceptions."""
    if isinstance(job.run, PredictionTopic):
        return score_topic(job.source, job.run, job.outputs)
    return replay(job.source, job.run, job.outputs, loader)


def outcome_of(job: ReplayJob, loader: ModelLoader) -> Outcome:
    """Run a job; every exception becomes an outcome."""
    try:
        metrics = run_job(job, loader)
    except EXPECTED_ERRORS as error:
        return Outcome(UNUSABLE, str(error))
    except Exception as error:
        return Outcome(CRASHED, f"{type(error).__name__}: {error}", traceback.format_exc())
    return Outcome(code_of(job, metrics), "; ".join(_wrong(job, metrics)))


def code_of(job: ReplayJob, metrics: dict[str, Any]) -> int:
    """The exit code of a job that gave these results."""
    return PARTIAL if _wrong(job, metrics) else ALL


def _wrong(job: ReplayJob, metrics: dict[str, Any]) -> list[str]:
    """What is not whole."""
    return [*metrics["recording"]["losses"], *(metrics["warnings"] if job.strict else [])]


def split(job: ReplayJob, topics: TopicChoice) -> list[ReplayJob]:
    """One job per image topic, each with a folder and a state file of its own.

    Args:
        job: What the jobs share.
        topics: Which topics.

    Returns:
        The jobs, in the topics' order; without a choice the job itself.

    Raises:
        RecordingError: The recording cannot be opened, or has no image topic.
    """
    names: Sequence[str] = topics.names
    if topics.every:
        names = [topic for topic in image_topics(job.source.recording) if topic]
    if not names:
        return [job]
    return [_of_topic(job, name) for name in names]


def _of_topic(job: ReplayJob, topic: str) -> ReplayJob:
    name = topic.strip("/").replace("/", "_")
    run = job.run
    if isinstance(run, Run):
        own = path_for(run.stream.state_file, name, shared=True)
        run = replace(run, stream=replace(run.stream, state_file=own))
    return replace(
        job,
        source=replace(job.source, image_topic=topic),
        run=run,
        outputs=replace(job.outputs, folder=job.outputs.folder / name),
    )
