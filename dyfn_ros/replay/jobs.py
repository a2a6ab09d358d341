"""One replay as a job: what is to be run, and how it ended."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.replay.options import ReplayOptions
from dyfn_ros.replay.run import ALL, PARTIAL, UNUSABLE, ModelLoader, replay

if TYPE_CHECKING:
    pass


CRASHED = 1  # the code of a recording whose worker died, or failed in a way that is our fault


@dataclass(frozen=True)
class ReplayJob:
    """One image topic of a recording to replay.

    name: of its folder and row. key: of all that decides the result.
    """

    name: str
    options: ReplayOptions
    key: str


@dataclass(frozen=True)
class Outcome:
    """How a replay ended: the exit code that dyfn-replay gives for it alone, or CRASHED."""

    code: int
    reason: str = ""
    traceback: str = ""


# Runs jobs and gives each with its outcome, in any order.
Runner = Callable[[Sequence[ReplayJob], ModelLoader], Iterator[tuple[ReplayJob, Outcome]]]


def run_one(options: ReplayOptions, loader: ModelLoader) -> Outcome:
    """Replay one recording; every exception becomes an outcome."""
    try:
        metrics = replay(options, loader)
    except (RecordingError, ValueError, OSError) as error:
        return Outcome(UNUSABLE, str(error))
    except Exception as error:
        return Outcome(CRASHED, f"{type(error).__name__}: {error}", traceback.format_exc())
    losses = metrics["recording"]["losses"]
    return Outcome(PARTIAL if losses else ALL, "; ".join(losses))
