"""`dyfn-depth`: the command."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dyfn_ros.depth.options import parse
from dyfn_ros.depth.settings import DepthJob

if TYPE_CHECKING:
    from dyfn_ros.depth.live import Open
    from dyfn_ros.depth.run import ModelLoader

ALL, UNUSABLE, PARTIAL, INTERRUPTED = 0, 2, 3, 130  # exit codes, as dyfn-replay's


def main(
    arguments: Sequence[str] | None = None,
    loader: ModelLoader | None = None,
    capture: Open | None = None,
) -> int:
    """Estimate the depth that the command line asks for.

    Args:
        arguments: Without the program's name; None: those of the process.
        loader: Gives the model; None: load_model.
        capture: Opens cameras and addresses; None: OpenCV.

    Returns:
        The exit code.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    job = parse(arguments)  # ends the process for --help and wrong options
    from dyfn_ros.recordings.errors import RecordingError

    try:
        return _execute(job, loader, capture)
    except (RecordingError, ValueError, OSError) as error:
        print(f"dyfn-depth: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-depth: interrupted twice, unfinished files were not written", file=sys.stderr)
        return INTERRUPTED


def _execute(job: DepthJob, loader: ModelLoader | None, capture: Open | None) -> int:
    from dyfn_ros.depth.live import open_capture  # seconds of torch: only now
    from dyfn_ros.depth.run import Stop, run
    from dyfn_ros.replay.run import load

    stop = Stop()
    with stop.listening():
        outcome = run(job, loader or load, stop, capture or open_capture)
    for word, found in (("loss", outcome.losses), ("warning", outcome.warnings)):
        for text, count in found.items():
            times = f" ({count} times)" if count > 1 else ""
            print(f"dyfn-depth: {word}: {text}{times}", file=sys.stderr)
    rate = outcome.frames / outcome.seconds
    done = "1 frame" if outcome.frames == 1 else f"{outcome.frames} frames"
    print(f"{done} in {outcome.seconds:.1f} s ({rate:.1f} a second)")
    for note in outcome.notes:
        print(note)
    for path in outcome.written:
        print(path)
    if outcome.interrupted:
        print("dyfn-depth: stopped before the end; what was done is kept", file=sys.stderr)
        return INTERRUPTED
    return PARTIAL if outcome.losses else ALL


if __name__ == "__main__":
    sys.exit(main())
