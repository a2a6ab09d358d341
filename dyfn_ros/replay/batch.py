"""Many recordings through `replay`: each in a process of its own, here or on a Ray cluster."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import re
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dyfn_core.data.files import hidden
from dyfn_core.files import write_text
from dyfn_core.models.checkpoints import model_fingerprint
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder
from dyfn_ros.replay.batch_ray import ray_runner
from dyfn_ros.replay.batch_summary import Row, write_summary
from dyfn_ros.replay.jobs import (
    ALL,
    CRASHED,
    PARTIAL,
    UNUSABLE,
    BatchJob,
    Outcome,
    Runner,
    outcome_of,
    split,
)
from dyfn_ros.replay.run import ModelLoader, load
from dyfn_ros.replay.settings import BatchOptions, PredictionTopic, ReplayJob, TopicChoice

USABLE = (ALL, PARTIAL)
RECORDING_FILE = re.compile(r"(?P<name>.+)\.(mcap|db3|bag)(\.zstd)?")
PART = re.compile(r"(?P<name>.*)_\d+")


def expand(paths: Sequence[Path]) -> list[Path]:
    """Recordings that the paths stand for.

    A .txt file lists paths, one a line (# begins a comment), relative to its folder. A folder that
    is no recording itself stands for the recordings in it, in the order of their names; bare
    files NAME_0, NAME_1 ... are parts of one recording. Raises RecordingError for a list that
    cannot be read or is empty.
    """
    found: list[Path] = []
    for path in paths:
        if path.suffix == ".txt":
            found += [one for entry in _listed(path) for one in _inside(entry)]
        else:
            found += _inside(path)
    return list(dict.fromkeys(found))


def is_many(paths: Sequence[Path]) -> bool:
    """Whether the paths are a batch, be it of one recording, and not a single recording."""
    return len(paths) > 1 or paths[0].suffix == ".txt" or _inside(paths[0]) != [paths[0]]


def _listed(path: Path) -> list[Path]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path}: expected a list of recordings: {error}") from error
    entries = [text for line in lines if (text := line.split("#")[0].strip())]
    if not entries:
        raise RecordingError(f"{path}: expected a recording a line, it lists none")
    return [path.parent / entry for entry in entries]


def _inside(path: Path) -> list[Path]:
    if not path.is_dir() or _is_recording(path):
        return [path]
    inside = [
        entry
        for entry in _visible(path)
        if (entry.is_dir() and _is_recording(entry)) or RECORDING_FILE.fullmatch(entry.name)
    ]
    return inside or [path]


def _is_recording(folder: Path) -> bool:
    """metadata.yaml, RGB-D, or bare files that are the parts of one recording."""
    if (folder / "metadata.yaml").exists() or is_rgbd_folder(folder):
        return True
    stems = {m["name"] for f in _visible(folder) if (m := RECORDING_FILE.fullmatch(f.name))}
    parts = {m["name"] if (m := PART.fullmatch(stem)) else stem for stem in stems}
    return len(parts) == 1 and not any(f.is_dir() and _is_recording(f) for f in _visible(folder))


def _visible(folder: Path) -> list[Path]:
    """What a folder holds, sorted, without hidden companions."""
    return sorted(entry for entry in folder.iterdir() if not hidden(entry))


def plan(
    recordings: Sequence[Path],
    job: ReplayJob,
    topics: TopicChoice,
    fingerprint: str,
) -> list[BatchJob]:
    """A job per recording and image topic, each with a folder of its own.

    Args:
        recordings: As `expand` returns them.
        job: What they share; its outputs' folder takes the folders.
        topics: Image topics of each recording.
        fingerprint: Of the model, a part of each job's key.

    Returns:
        The jobs, in the recordings' order.
    """
    jobs: list[BatchJob] = []
    taken: set[str] = set()
    top = job.outputs.folder.absolute()
    for recording in recordings:
        path = recording.absolute()  # a link keeps its own name
        name = _free_name(path, taken)
        taken.add(name)
        own = replace(
            job,
            source=replace(job.source, recording=path),
            outputs=replace(job.outputs, folder=top / name, progress=False),
        )
        for one in _split(own, topics):
            jobs.append(
                BatchJob(str(one.outputs.folder.relative_to(top)), one, _key(one, fingerprint))
            )
    return jobs


def _free_name(path: Path, taken: set[str]) -> str:
    """A recording's own name, made longer while it is taken."""
    match = RECORDING_FILE.fullmatch(path.name)
    name = path.name if match is None or path.is_dir() else match["name"]
    name = name if name not in taken else f"{path.parent.name}_{name}"
    number, free = 2, name
    while free in taken:
        number, free = number + 1, f"{name}-{number}"
    return free


def _split(job: ReplayJob, topics: TopicChoice) -> list[ReplayJob]:
    try:
        return split(job, topics)
    except RecordingError:  # its replay says why, and the others go on
        return [job]


def _key(job: ReplayJob, fingerprint: str) -> str:
    """Hash of the options, the model, and the names, sizes and times of the recording's files."""
    path = job.source.recording
    files = sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]
    state = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in files if f.exists()]
    # Where results go and what is shown meanwhile does not change them.
    parts = asdict(replace(job, outputs=replace(job.outputs, folder=Path(), progress=False)))
    text = json.dumps([parts, type(job.run).__name__, fingerprint, state], default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def replay_all(
    recordings: Sequence[Path],
    job: ReplayJob,
    topics: TopicChoice,
    batch: BatchOptions,
    loader: ModelLoader = load,
) -> int:
    """Replay every recording into its own folder and write the summary over all.

    Recordings that are finished with the same options, weights and files are not run again. One
    that fails is reported and the others go on.

    Args:
        recordings: As `expand` returns them.
        job: What they share; its outputs' folder takes their folders and the summary.
        topics: Image topics of each recording.
        batch: Where the jobs run.
        loader: Gives the models.

    Returns:
        ALL when all are whole, PARTIAL when some are partial or failed, UNUSABLE when none gave
        results.

    Raises:
        OutputError: The summary or an outcome cannot be written; or whatever `loader` raises.
    """
    fingerprint = ""
    if not isinstance(job.run, PredictionTopic):
        fingerprint = model_fingerprint(loader(job.run.model, "cpu"))
    jobs = plan(recordings, job, topics, fingerprint)
    outcomes = {one.name: done for one in jobs if (done := _finished(one)) is not None}
    waiting = [one for one in jobs if one.name not in outcomes]
    if outcomes:
        print(f"{len(outcomes)} of {len(jobs)} were finished before and are kept", file=sys.stderr)
    for one, outcome in tqdm(
        _runner(batch)(waiting, loader), total=len(waiting), unit="recording", file=sys.stderr
    ):
        outcomes[one.name] = outcome
        _remember(one, outcome)
        if outcome.code != ALL:
            kind = "partial" if outcome.code == PARTIAL else f"failed (code {outcome.code})"
            path = one.job.source.recording
            print(f"dyfn-replay: {path}: {kind}: {outcome.reason}", file=sys.stderr)
    rows = [_row(one, outcomes[one.name]) for one in jobs]
    for row in rows:
        for text in row.metrics.get("warnings", []):
            print(f"dyfn-replay: {row.path}: implausible: {text}", file=sys.stderr)
    print(write_summary(job.outputs.folder, rows))
    codes = {row.code for row in rows}
    if not codes & set(USABLE):
        return UNUSABLE
    return ALL if codes == {ALL} else PARTIAL


def _runner(batch: BatchOptions) -> Runner:
    if batch.ray is not None:
        return ray_runner(batch.ray, batch.jobs)
    return lambda jobs, loader: run_locally(jobs, loader, batch.jobs)


def _finished(job: BatchJob) -> Outcome | None:
    """What is remembered of an earlier run that gave results of the same key."""
    folder = job.job.outputs.folder
    try:
        known = json.loads((folder / "outcome.json").read_text(encoding="utf-8"))
        same = known["key"] == job.key and known["code"] in USABLE
        done = same and (folder / "metrics.json").exists()
        return Outcome(known["code"], known["reason"]) if done else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _remember(job: BatchJob, outcome: Outcome) -> None:
    folder = job.job.outputs.folder
    folder.mkdir(parents=True, exist_ok=True)
    known = {"key": job.key, "recording": str(job.job.source.recording), **asdict(outcome)}
    write_text(folder / "outcome.json", json.dumps(known, indent=2) + "\n")


def _row(job: BatchJob, outcome: Outcome) -> Row:
    metrics: dict[str, Any] = {}
    if outcome.code in USABLE:
        text = (job.job.outputs.folder / "metrics.json").read_text(encoding="utf-8")
        metrics = json.loads(text)
    return Row(job.name, str(job.job.source.recording), outcome.code, outcome.reason, metrics)


def run_locally(
    jobs: Sequence[BatchJob], loader: ModelLoader, workers: int
) -> Iterator[tuple[BatchJob, Outcome]]:
    """A fresh process for each, `workers` at a time: one that dies takes no other along."""
    alive: set[Any] = set()
    with ThreadPoolExecutor(max(1, workers)) as pool:
        futures = {pool.submit(_in_process, one.job, loader, alive): one for one in jobs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:
                future.cancel()
            for process in tuple(alive):
                process.terminate()


def _in_process(job: ReplayJob, loader: ModelLoader, alive: set[Any]) -> Outcome:
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(sender, job, loader), daemon=True)
    process.start()
    alive.add(process)
    sender.close()  # so that the worker's end is the only one, and its death is an end of file
    try:
        outcome: Outcome = receiver.recv()
    except EOFError:
        process.join()
        return Outcome(CRASHED, f"its process ended with code {process.exitcode}")
    finally:
        process.join()
        alive.discard(process)
    return outcome


def _work(sender: Connection, job: ReplayJob, loader: ModelLoader) -> None:
    sender.send(outcome_of(job, loader))
