"""What a parsed command line asks for, done and told."""

from __future__ import annotations

import sys

from dyfn_core.evaluation.report.html import text_table
from dyfn_core.evaluation.sequence import score_table
from dyfn_ros.recordings.image_recording import is_image_recording
from dyfn_ros.replay.batch import expand, is_many, replay_all
from dyfn_ros.replay.jobs import EXPECTED_ERRORS, PARTIAL, UNUSABLE, code_of, run_job, split
from dyfn_ros.replay.options import Command
from dyfn_ros.replay.results import results_by_name
from dyfn_ros.replay.run import ModelLoader, load
from dyfn_ros.replay.settings import FILES, ReplayJob, Run

INTERRUPTED = 130


def execute(command: Command, loader: ModelLoader | None = None) -> int:
    """Run a command; errors of input, options and disk become a line on stderr.

    Args:
        command: As options.parse returns it.
        loader: Gives the models; None: load_model.

    Returns:
        The exit code.
    """
    try:
        return _execute(command, loader or load)
    except EXPECTED_ERRORS as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-replay: interrupted, unfinished results were not written", file=sys.stderr)
        return INTERRUPTED


def _execute(command: Command, loader: ModelLoader) -> int:
    if is_many(command.recordings):
        run = command.job.run
        if isinstance(run, Run) and run.stream.state_file:
            raise ValueError("--state-file is for one recording, several were given")
        recordings = expand(command.recordings)
        return replay_all(recordings, command.job, command.topics, command.batch, loader)
    codes = {_replay_and_tell(job, loader) for job in split(command.job, command.topics)}
    return codes.pop() if len(codes) == 1 else PARTIAL


def _replay_and_tell(job: ReplayJob, loader: ModelLoader) -> int:
    try:
        metrics = run_job(job, loader)
    except EXPECTED_ERRORS as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    notes, folder = metrics["recording"], job.outputs.folder
    for kind, word in (("losses", "loss"), ("warnings", "warning")):
        for text, count in notes[kind].items():
            times = f" ({count} times)" if count > 1 else ""
            print(f"dyfn-replay: {word}: {text}{times}", file=sys.stderr)
    for text in metrics["warnings"]:
        print(f"dyfn-replay: implausible: {text}", file=sys.stderr)
    count = metrics["frames"]
    print(f"{count} frame{'' if count == 1 else 's'} of {job.source.recording}")
    for text in metrics.get("state", {}).values():
        print(f"state: {text}")
    print(text_table(score_table(results_by_name(metrics))))
    if is_image_recording(job.source.recording):
        told = f"for depth as video or files: dyfn-depth {job.source.recording}"
        print(f"it has no ground truth, so nothing is scored; {told}")
    written = [name for name in dict.fromkeys(FILES.values()) if (folder / name).exists()]
    listed = ", ".join(["report.html", "metrics.json", "frames.csv", *written])
    print(f"results in {folder}: {listed}")
    return code_of(job, metrics)
