"""Which frames of a recording are learned from, which decide, and which are kept for a test."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dyfn_core.adaptation.recording import SparseFrames
from dyfn_core.data.frames import DataError

BLOCK = 20.0  # seconds with one held-back segment, at the end
FEWEST = 8  # frames with points that each part needs
GUARD = 1.0  # seconds before a held-back segment that are not learned from: its points rest on them


@dataclass(frozen=True)
class Parts:
    """Frames of a recording, each in the order of time.

    Attributes:
        runs: First and last frame of each run of neighbours that is learned from.
        held_back: Frames that decide.
        test: Frames that do not.
    """

    runs: tuple[tuple[int, int], ...]
    held_back: tuple[int, ...]
    test: tuple[int, ...]


def parts_of(frames: SparseFrames, hold_back: float, test: float) -> Parts:
    """Cut a recording by time: blocks with a held-back segment each, and the test at the end.

    Args:
        frames: The recording.
        hold_back: Share of each block.
        test: Share of the recording.

    Raises:
        DataError: A part has hardly any points.
    """
    stamps, edges = frames.stamps.numpy(), (*frames.starts, len(frames))
    # Time goes on by a frame's while a stretch ends, so that bags that loop are cut as well.
    steps = np.diff(stamps, prepend=stamps[0])
    steps[list(frames.starts)] = float(np.median(steps[1:])) if len(steps) > 1 else 0.0
    time = np.cumsum(steps) - steps[0]
    whole = float(time[-1])
    end = whole * (1 - test)
    blocks = max(1, math.floor(end / BLOCK))
    tested = time > end
    phase = np.where(tested, 0.0, np.minimum(time * blocks / max(end, 1e-9), blocks - 1e-9)) % 1.0
    held = ~tested & (phase >= 1 - hold_back)
    guard = GUARD / max(end / blocks, 1e-9)
    learned = ~tested & ~held & (phase < 1 - hold_back - guard)
    runs = []
    for first, last in pairwise(edges):
        places = np.flatnonzero(learned[first:last]) + first
        cuts = np.flatnonzero(np.diff(places) > 1) + 1
        runs += [(int(run[0]), int(run[-1])) for run in np.split(places, cuts) if len(run) > 1]
    found = Parts(tuple(runs), _places(held), _places(tested))
    _check(frames, found)
    return found


def _places(chosen: np.ndarray) -> tuple[int, ...]:
    return tuple(np.flatnonzero(chosen).tolist())


def _check(frames: SparseFrames, parts: Parts) -> None:
    seen = frames.seen.numpy()
    learned = np.zeros(len(frames), bool)
    for first, last in parts.runs:
        learned[first : last + 1] = True
    told = {"learned from": learned & seen}
    for name, chosen in (("held back", parts.held_back), ("kept for the test", parts.test)):
        if chosen or name == "held back":
            told[name] = np.isin(np.arange(len(frames)), chosen) & seen
    for name, there in told.items():
        if int(there.sum()) < FEWEST:
            raise DataError(
                f"{frames.name}: {int(there.sum())} frames with enough points are {name}, expected "
                f"at least {FEWEST}: give a longer recording, a higher --rate, or other shares "
                "(--hold-back, --test)"
            )
