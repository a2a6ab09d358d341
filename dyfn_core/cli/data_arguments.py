"""The frames that a sub-command of dyfn-eval works on, as command-line arguments."""

from __future__ import annotations

import argparse

from dyfn_core.cli.arguments import (
    add_backend,
    add_device,
    add_max_frames,
    add_model,
    add_num_tokens,
    add_out,
    add_start,
    add_stride,
)


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
    add_backend(group)
