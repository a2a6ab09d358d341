"""`dyfn-replay`: the command line."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dyfn_core.evaluation.report.html import text_table
from dyfn_core.evaluation.sequence import score_table
from dyfn_ros.recordings.open import (
    RecordingError,
)
from dyfn_ros.replay.options import Command, ReplayOptions, parse, split
from dyfn_ros.replay.outputs import FILES
from dyfn_ros.replay.results import results_by_name

if TYPE_CHECKING:
    pass
from dyfn_ros.replay.run import ALL, PARTIAL, UNUSABLE, ModelLoader, load, replay


def main(arguments: Sequence[str] | None = None, loader: ModelLoader = load) -> int:
    """-> exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    command = parse(arguments)
    try:
        return _replay_command(command, loader)
    except (RecordingError, ValueError, OSError) as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-replay: interrupted, unfinished results were not written", file=sys.stderr)
        return 130


def _replay_command(command: Command, loader: ModelLoader) -> int:
    from dyfn_ros.replay import batch as fleet

    if fleet.is_many(command.recordings):
        chosen = fleet.BatchOptions(command.jobs, command.ray)
        recordings = fleet.expand(command.recordings)
        return fleet.replay_all(recordings, command.options, chosen, loader)
    codes = {_replay_and_tell(one, loader) for one in split(command.options)}
    return codes.pop() if len(codes) == 1 else PARTIAL


def _replay_and_tell(options: ReplayOptions, loader: ModelLoader) -> int:
    try:
        metrics = replay(options, loader)
    except (RecordingError, ValueError, OSError) as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    notes = metrics["recording"]
    for kind, word in (("losses", "loss"), ("warnings", "warning")):
        for text, count in notes[kind].items():
            times = f" ({count} times)" if count > 1 else ""
            print(f"dyfn-replay: {word}: {text}{times}", file=sys.stderr)
    print(f"{metrics['frames']} frames of {options.recording}")
    print(text_table(score_table(results_by_name(metrics))))
    written = [name for name in FILES.values() if (options.out / name).exists()]
    listed = ", ".join(["report.html", "metrics.json", "frames.csv", *written])
    print(f"results in {options.out}: {listed}")
    return PARTIAL if notes["losses"] else ALL


if __name__ == "__main__":
    sys.exit(main())
