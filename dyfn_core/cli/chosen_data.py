"""The frames that command-line arguments choose."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyfn_core.data.datasets import RENDERED
from dyfn_core.data.frames import DataError, FrameSequence
from dyfn_core.data.pool import DataSpec, open_pool, resolve


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
