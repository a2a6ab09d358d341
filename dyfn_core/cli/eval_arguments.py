"""Options that the sub-commands of dyfn-eval share."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyfn_core.argument_types import above_zero, finite_above_zero, not_negative
from dyfn_core.cli.arguments import (
    Options,
    add_backend,
    add_controls,
    add_device,
    add_max_frames,
    add_model,
    add_num_tokens,
    add_out,
    add_stabilize,
    add_start,
    add_stride,
    renamed,
)
from dyfn_core.evaluation.choices import AUTO, LAYOUTS, METRES
from dyfn_core.quantities import QUANTITIES
from dyfn_core.scoring.fits import FITS, L1


def add_benchmark(command: argparse.ArgumentParser) -> None:
    """What is scored of which data set, and how."""
    group = command.add_argument_group("benchmark and results")
    group.add_argument(
        "--benchmark", required=True, metavar="NAME", help="a name that `dyfn-eval list` prints"
    )
    data = group.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="folder of the data set"
    )
    renamed(group, "--root", data)
    add_out(group)
    group.add_argument("--name", help="name of the method in the tables")
    group = command.add_argument_group("frames (default: as in the paper)")
    group.add_argument(
        "--layout",
        choices=LAYOUTS,
        default=AUTO,
        help="layout of the folder (default: auto, by what is in it)",
    )
    group.add_argument(
        "--sequences", nargs="+", default=[], metavar="NAME", help="only these sequences"
    )
    group.add_argument(
        "--allow-missing", action="store_true", help="score the sequences that are there"
    )
    renamed(group, "--first", add_start(group))
    add_stride(group, None)
    renamed(group, "--frames", add_max_frames(group))
    group.add_argument("--all-frames", action="store_true", help="no limit on the number of frames")
    group.add_argument(
        "--depth-max", type=above_zero, metavar="METRES", help="cap of the ground truth, metres"
    )
    group.add_argument(
        "--crop",
        type=not_negative,
        nargs=2,
        metavar=("ROWS", "COLUMNS"),
        help="pixels cut off above and below, and at the left and right",
    )
    group = command.add_argument_group("scores")
    group.add_argument(
        "--fit",
        choices=FITS,
        default=L1,
        help=f"alignment: weighted L1 as in the paper, or least squares (default: {L1})",
    )
    group.add_argument(
        "--all-pixels",
        action="store_true",
        help="use every pixel, which takes memory; default: a grid of at most 20000 per frame",
    )


def add_run(command: argparse.ArgumentParser, given: Options | None = None) -> None:
    """A model that is run.

    Args:
        command: the sub-command.
        given: where --model is added as an optional choice; None: it must be given.
    """
    group = command.add_argument_group("model")
    if given is None:
        add_model(group, required=True)
    else:
        given.add_argument("--model", help="model to run: bundled name, checkpoint file, or Hub id")
    add_stabilize(group)
    add_controls(group, default=True)
    add_num_tokens(group)
    group.add_argument(
        "--known-camera", action="store_true", help="give the model the benchmark's intrinsics"
    )
    group.add_argument(
        "--metres-from",
        nargs="+",
        choices=METRES,
        default=[],
        help="also score it in metres, by the points that the benchmark gives (VOID), or by points "
        "that are triangulated with its poses",
    )
    add_device(group)
    add_backend(group)


def add_predictions(command: argparse.ArgumentParser, given: Options | None = None) -> None:
    """Files that are read.

    Args:
        command: the sub-command.
        given: where --predictions is added as an optional choice; None: it must be given.
    """
    group = command.add_argument_group("predictions")
    target = group if given is None else given
    target.add_argument(
        "--predictions",
        type=Path,
        required=given is None,
        metavar="DIR",
        help="SEQUENCE.npz, SEQUENCE.npy (T x H x W), or SEQUENCE/ with one .npz, .npy, 16-bit "
        ".png or .exr per frame",
    )
    group.add_argument(
        "--quantity",
        choices=QUANTITIES,
        required=given is None,
        default=None if given is None else QUANTITIES[0],
        help="what the files hold. depth; disparity: a / depth + b; inverse: a / depth",
    )
    scale = group.add_argument(
        "--depth-scale",
        type=finite_above_zero,
        dest="scale",
        metavar="X",
        help="stored values per unit; needed for .png",
    )
    renamed(group, "--scale", scale)
    group.add_argument("--key", help="name of the array in .npz files that hold several")
