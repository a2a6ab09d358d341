"""The frames that a sub-command of dyfn-eval works on, as command-line arguments."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyfn_core.data.datasets import RENDERED
from dyfn_core.data.frames import DataError, FrameSequence
from dyfn_core.data.pool import DataSpec, open_pool, resolve


def add_data_arguments(parser: argparse.ArgumentParser) -> None:
    """Which data and frames, which model, and where the results go."""
    add = parser.add_argument
    add("data", metavar="[KIND=]PATH", help="RGB-D folder, recording or data set with depth")
    add("--sequence", help="name (or its end) of one sequence; default: the first")
    add("--split", default="held_out", help="of rendered folders: held_out or train")
    add("--start", type=int, default=0, help="first frame, counted from 0")
    add("--stride", type=int, default=1, help="take every N-th frame")
    add("--max-frames", type=int, help="stop after so many")
    add("--model", default="dyfn-mini", help="bundled name, checkpoint file, or Hub id")
    add("--num-tokens", type=int, help="resolution inside the model")
    add("--device", default="cpu", help="cpu, cuda, cuda:N")
    add("--out", type=Path, required=True, help="folder for the results")


def open_sequence(options: argparse.Namespace) -> FrameSequence:
    """The chosen sequence. Raises DataError or FileNotFoundError naming what is there."""
    kind, found, root = options.data.partition("=")
    named = bool(found) and not Path(options.data).exists()
    spec = DataSpec(Path(root), kind) if named else DataSpec(Path(options.data))
    split = options.split if resolve(spec) == RENDERED else "train"  # others have one split
    sequences = open_pool([spec], split).sequences
    if options.sequence is None:
        return sequences[0]
    for sequence in sequences:
        if sequence.name.endswith(options.sequence):
            return sequence
    names = ", ".join(sequence.name for sequence in sequences[:8])
    raise DataError(f"{options.data}: no sequence {options.sequence!r}; there are {names}")


def places(options: argparse.Namespace, length: int) -> range:
    """Which frames to take. Raises ValueError when an option is out of range or none is left."""
    for name, low in (("start", 0), ("stride", 1), ("max_frames", 1)):
        value = getattr(options, name)
        if value is not None and value < low:
            raise ValueError(f"--{name.replace('_', '-')} must be at least {low}, got {value}")
    chosen = range(options.start, length, options.stride)
    chosen = chosen[: options.max_frames]
    if not chosen:
        raise ValueError(f"--start {options.start} is behind the last of {length} frames")
    return chosen
