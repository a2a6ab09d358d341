"""The command line of dyfn-train adapt."""

from __future__ import annotations

import argparse
from pathlib import Path

from dyfn_core.adaptation.defaults import DECODER, HOLD_BACK, RATE, SEED, STEPS, TEST
from dyfn_core.argument_types import above_zero, at_least_one
from dyfn_core.cli.arguments import Commands, add_model, add_out, described


def add_parser(commands: Commands) -> None:
    """Add the sub-command."""
    purpose = "adapt a model to recordings with odometry, by triangulated points"
    command = commands.add_parser(
        "adapt",
        help=purpose,
        description=described(purpose),
        epilog="Exit status: 0, the model was written; 1, it has not become better, and was not, "
        "or something is wrong.",
    )
    command.add_argument(
        "recordings",
        nargs="+",
        metavar="[KIND=]RECORDING",
        help="bag, MCAP file or RGB-D folder with poses; with options: "
        "'{root: PATH, odometry_topic: /odom}'",
    )
    add_out(command, "file of the model, NAME.safetensors").metavar = "FILE"
    add_model(command)
    _add_learning(command.add_argument_group("what learns"))
    group = command.add_argument_group("run")
    group.add_argument(
        "--run", type=Path, metavar="DIR", help="folder of the run (default: NAME.run beside FILE)"
    )
    group.add_argument("--resume", action="store_true", help="go on from the run's checkpoint")
    group.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override a setting"
    )


def _add_learning(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add(
        "--decoder",
        choices=DECODER,
        help=f"part of the decoder that learns beside DyFN (default: {DECODER[0]})",
    )
    add(
        "--rate",
        type=above_zero,
        metavar="HZ",
        help=f"frames a second that are learned from (default: {RATE:g})",
    )
    add(
        "--hold-back",
        type=float,
        metavar="SHARE",
        help="of each 20 s, which decides when to stop and whether the model is better "
        f"(default: {HOLD_BACK:g})",
    )
    add(
        "--test",
        type=float,
        metavar="SHARE",
        help="at the end of each recording, which is scored and decides nothing "
        f"(default: {TEST:g})",
    )
    add(
        "--steps",
        type=at_least_one,
        metavar="N",
        help=f"at most so many (default: {STEPS})",
    )
    add("--seed", type=int, metavar="N", help=f"of all draws (default: {SEED})")
