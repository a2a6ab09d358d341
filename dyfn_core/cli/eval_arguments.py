"""Options that the sub-commands of dyfn-eval share."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyfn_core.evaluation.benchmarks.predictions import QUANTITIES
from dyfn_core.evaluation.benchmarks.registry import AUTO, LAYOUTS
from dyfn_core.scoring.protocols import FITS, L1


def add_benchmark(command: argparse.ArgumentParser) -> None:
    """What is scored of which data set, and how."""
    command.add_argument("--benchmark", required=True, help="a name of `dyfn-eval list`")
    command.add_argument("--root", type=Path, required=True, help="folder of the data set")
    command.add_argument("--out", type=Path, required=True, help="folder for the results")
    command.add_argument("--name", help="of the method in tables")
    group = command.add_argument_group("what is scored of it (default: as in the paper)")
    group.add_argument("--layout", choices=LAYOUTS, default=AUTO, help="default: found out")
    group.add_argument("--sequences", nargs="+", default=[], metavar="NAME", help="only these")
    group.add_argument("--allow-missing", action="store_true", help="score what is there")
    group.add_argument("--first", type=int, help="frames left out at the start")
    group.add_argument("--stride", type=int, help="every so-many-th frame")
    group.add_argument("--frames", type=int, help="at most so many of a sequence")
    group.add_argument("--all-frames", action="store_true", help="no limit")
    group.add_argument("--depth-max", type=float, metavar="METRES", help="cap of the truth")
    group.add_argument(
        "--crop", type=int, nargs=2, metavar=("ROWS", "COLUMNS"), help="cut off at each side"
    )
    group = command.add_argument_group("how it is scored")
    group.add_argument(
        "--fit", choices=FITS, default=L1, help="alignment: weighted L1 (paper), least squares"
    )
    group.add_argument(
        "--all-pixels",
        action="store_true",
        help="every pixel, in memory that grows; default: a grid of at most 20000 a frame",
    )


def add_model(command: argparse.ArgumentParser, required: bool) -> None:
    """A model that is run. required: --model is an option of the group, and needed."""
    group = command.add_argument_group("model")
    if required:
        group.add_argument("--model", required=True, help="checkpoint, Hub id or dyfn-mini")
    group.add_argument(
        "--no-stabilizer", dest="stabilizer", action="store_false", help="the base model alone"
    )
    group.add_argument(
        "--no-controls",
        dest="controls",
        action="store_false",
        help="leave out the moving average and the frozen statistics",
    )
    group.add_argument("--num-tokens", type=int, help="how finely to look")
    group.add_argument(
        "--known-camera", action="store_true", help="tell the model the benchmark's intrinsics"
    )
    group.add_argument("--device", default="cpu", help="of torch (default: cpu)")


def add_predictions(command: argparse.ArgumentParser, required: bool) -> None:
    """Files that are read. required: --predictions is an option of the group, and needed."""
    group = command.add_argument_group("predictions")
    if required:
        group.add_argument(
            "--predictions",
            type=Path,
            required=True,
            metavar="DIR",
            help="SEQUENCE.npz, SEQUENCE.npy (T x H x W), or SEQUENCE/ with one .npz, .npy, 16-bit "
            ".png or .exr a frame",
        )
    group.add_argument(
        "--quantity",
        choices=QUANTITIES,
        required=required,
        default=None if required else QUANTITIES[0],
        help="depth; disparity: a / depth + b; inverse: a / depth",
    )
    group.add_argument("--scale", type=float, help="stored values per unit; needed for .png")
    group.add_argument("--key", help="of the array in .npz files that hold several")
