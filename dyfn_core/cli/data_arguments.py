"""The frames that a sub-command of dyfn-eval works on, as command-line arguments."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyfn_core.cli.arguments import (
    add_device,
    add_max_frames,
    add_model,
    add_num_tokens,
    add_out,
    add_start,
    add_stride,
)
from dyfn_core.data.datasets import RENDERED
from dyfn_core.data.frames import DataError, FrameSequence
from dyfn_core.data.pool import DataSpec, open_pool, resolve


def add_data_arguments(parser: argparse.ArgumentParser) -> None:
    """Which data and frames, which model, and where the results go."""
    parser.add_argument(
        "data", metavar="[KIND=]PATH", help="RGB-D folder, recording or data set with depth"
    )
    add_out(parser)
    group = parser.add_argument_group("frames")
    group.add_argument(
        "--sequence",
        metavar="NAME",
        help="one sequence, by its name or its end (default: the first)",
    )
    group.add_argument(
        "--split",
        default="held_out",
        choices=("held_out", "train"),
        help="split of rendered folders (default: held_out)",
    )
    add_start(group)
    add_stride(group)
    add_max_frames(group)
    group = parser.add_argument_group("model")
    add_model(group)
    add_num_tokens(group)
    add_device(group)


def data_spec(text: str) -> DataSpec:
    """[KIND=]PATH as it is typed."""
    kind, found, root = text.partition("=")
    named = bool(found) and not Path(text).exists()
    return DataSpec(Path(root), kind) if named else DataSpec(Path(text))


def open_sequence(options: argparse.Namespace) -> FrameSequence:
    """The chosen sequence. Raises DataError or FileNotFoundError naming what is there."""
    spec = data_spec(options.data)
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
    """Which of `length` frames to take. Raises ValueError when --start leaves none."""
    chosen = range(options.start or 0, length, options.stride)[: options.max_frames]
    if not chosen:
        raise ValueError(f"--start {options.start} is behind the last of {length} frames")
    return chosen
