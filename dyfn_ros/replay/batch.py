"""Many recordings through `replay`: each in a process of its own, here or on a Ray cluster."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import re
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from dyfn_core.files import finished_file
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder
from dyfn_ros.replay.batch_summary import Row, write_summary
from dyfn_ros.replay.jobs import CRASHED, Outcome, ReplayJob, Runner, run_one
from dyfn_ros.replay.options import ReplayOptions, split
from dyfn_ros.replay.run import ALL, PARTIAL, UNUSABLE, ModelLoader, load

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

USABLE = (ALL, PARTIAL)
RECORDING_FILE = re.compile(r"(?P<name>.+)\.(mcap|db3|bag)(\.zstd)?")
PART = re.compile(r"(?P<name>.*)_\d+")
# Where the results go and what is shown meanwhile: the results are the same.
FREE_OPTIONS = ("recording", "out", "progress")


@dataclass(frozen=True)
class BatchOptions:
    """jobs: worker processes here. ray: a cluster's address, "local" for one made here, or None."""

    jobs: int = 1
    ray: str | None = None


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
    """Whether the paths are a fleet, be it of one, or one recording."""
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
        for entry in sorted(path.iterdir())
        if (entry.is_dir() and _is_recording(entry)) or RECORDING_FILE.fullmatch(entry.name)
    ]
    return inside or [path]


def _is_recording(folder: Path) -> bool:
    """metadata.yaml, RGB-D, or bare files that are the parts of one recording."""
    if (folder / "metadata.yaml").exists() or is_rgbd_folder(folder):
        return True
    stems = {m["name"] for f in folder.iterdir() if (m := RECORDING_FILE.fullmatch(f.name))}
    parts = {m["name"] if (m := PART.fullmatch(stem)) else stem for stem in stems}
    return len(parts) == 1 and not any(f.is_dir() and _is_recording(f) for f in folder.iterdir())


def plan(recordings: Sequence[Path], options: ReplayOptions, checksum: str) -> list[ReplayJob]:
    """A job per recording and image topic, each with a folder of its own under options.out."""
    jobs: list[ReplayJob] = []
    taken: set[str] = set()
    for recording in recordings:
        path = recording.absolute()  # a link keeps its own name
        match = RECORDING_FILE.fullmatch(path.name)
        name = path.name if match is None or path.is_dir() else match["name"]
        name = name if name not in taken else f"{path.parent.name}_{name}"
        number, free = 2, name
        while free in taken:
            number, free = number + 1, f"{name}-{number}"
        taken.add(free)
        own = replace(options, recording=path, out=options.out.absolute() / free, progress=False)
        for one in _topics(own):
            part = one.out.relative_to(own.out)
            jobs.append(ReplayJob(str(Path(free) / part), one, _key(one, checksum)))
    return jobs


def _topics(options: ReplayOptions) -> list[ReplayOptions]:
    try:
        return split(options)
    except RecordingError:  # the replay of it says why, and the others go on
        return [options]


def _key(options: ReplayOptions, checksum: str) -> str:
    """Of the options, the model's weights, and the recording's files, sizes and times."""
    path = options.recording
    files = sorted(f for f in path.rglob("*") if f.is_file()) if path.is_dir() else [path]
    state = [(str(f), f.stat().st_size, f.stat().st_mtime_ns) for f in files if f.exists()]
    chosen = {name: v for name, v in asdict(options).items() if name not in FREE_OPTIONS}
    text = json.dumps([chosen, checksum, state], default=str, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def model_checksum(model: GeometryModel) -> str:
    """SHA-256 over names and bytes of all weights."""
    found = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        found.update(name.encode())
        found.update(tensor.detach().cpu().contiguous().flatten().numpy().tobytes())
    return found.hexdigest()


def replay_all(
    recordings: Sequence[Path],
    options: ReplayOptions,
    fleet: BatchOptions,
    loader: ModelLoader = load,
) -> int:
    """Replay every recording into its own folder and write the summary over all; -> exit code.

    Recordings that are finished with the same options, weights and files are not run again. One
    that fails is reported and the others go on. ALL when all are whole, PARTIAL when some are
    partial or failed, UNUSABLE when none gave results. Raises what loader raises, OutputError.
    """
    checksum = model_checksum(loader(options.model, "cpu"))
    jobs = plan(recordings, options, checksum)
    outcomes = {job.name: done for job in jobs if (done := _finished(job)) is not None}
    waiting = [job for job in jobs if job.name not in outcomes]
    if outcomes:
        print(f"{len(outcomes)} of {len(jobs)} were finished before and are kept", file=sys.stderr)
    for job, outcome in tqdm(
        _runner(fleet)(waiting, loader), total=len(waiting), unit="recording", file=sys.stderr
    ):
        outcomes[job.name] = outcome
        _remember(job, outcome)
        if outcome.code != ALL:
            kind = "partial" if outcome.code == PARTIAL else f"failed (code {outcome.code})"
            print(
                f"dyfn-replay: {job.options.recording}: {kind}: {outcome.reason}", file=sys.stderr
            )
    rows = [_row(job, outcomes[job.name]) for job in jobs]
    print(write_summary(options.out, rows))
    codes = {row.code for row in rows}
    if not codes & set(USABLE):
        return UNUSABLE
    return ALL if codes == {ALL} else PARTIAL


def _runner(fleet: BatchOptions) -> Runner:
    if fleet.ray is not None:
        from dyfn_ros.replay.batch_ray import ray_runner

        return ray_runner(fleet.ray, fleet.jobs)
    return lambda jobs, loader: run_locally(jobs, loader, fleet.jobs)


def _finished(job: ReplayJob) -> Outcome | None:
    """What is remembered of an earlier run that gave results of the same key."""
    try:
        known = json.loads((job.options.out / "outcome.json").read_text(encoding="utf-8"))
        same = known["key"] == job.key and known["code"] in USABLE
        done = same and (job.options.out / "metrics.json").exists()
        return Outcome(known["code"], known["reason"]) if done else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


def _remember(job: ReplayJob, outcome: Outcome) -> None:
    job.options.out.mkdir(parents=True, exist_ok=True)
    known = {"key": job.key, "recording": str(job.options.recording), **asdict(outcome)}
    with finished_file(job.options.out / "outcome.json") as partial:
        partial.write_text(json.dumps(known, indent=2) + "\n", encoding="utf-8")


def _row(job: ReplayJob, outcome: Outcome) -> Row:
    metrics: dict[str, Any] = {}
    if outcome.code in USABLE:
        metrics = json.loads((job.options.out / "metrics.json").read_text(encoding="utf-8"))
    return Row(job.name, str(job.options.recording), outcome.code, outcome.reason, metrics)


def run_locally(
    jobs: Sequence[ReplayJob], loader: ModelLoader, workers: int
) -> Iterator[tuple[ReplayJob, Outcome]]:
    """A fresh process for each, `workers` at a time: one that dies takes no other along."""
    alive: set[Any] = set()
    with ThreadPoolExecutor(max(1, workers)) as pool:
        futures = {pool.submit(_in_process, job.options, loader, alive): job for job in jobs}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            for future in futures:
                future.cancel()
            for process in tuple(alive):
                process.terminate()


def _in_process(options: ReplayOptions, loader: ModelLoader, alive: set[Any]) -> Outcome:
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(sender, options, loader), daemon=True)
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


def _work(sender: Connection, options: ReplayOptions, loader: ModelLoader) -> None:
    sender.send(run_one(options, loader))
