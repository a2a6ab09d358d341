"""`dyfn-train`: the command line. It imports no torch before it has read its arguments."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dyfn_core.argument_types import at_least_one, finite
from dyfn_core.cli import adapt_options, experiments_options
from dyfn_core.cli.arguments import (
    Commands,
    add_out,
    add_stride,
    command_parser,
    described,
    renamed,
)
from dyfn_core.training.former_config import SCALE, STABILIZER


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parser().parse_args(arguments)  # ends the process for --help and wrong options
    from dyfn_core.cli.train_commands import execute  # seconds of torch: only now

    return execute(options)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(
        "dyfn-train", "Train the small model's base, or DyFN on top of it, and score the result."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    purposes = {
        "base": "train encoder and head on rendered frames",
        "dyfn": "train DyFN on clips or recordings, everything else frozen",
        STABILIZER: "former name of `dyfn` with method.kind 'unrolled'",
        SCALE: "former name of `dyfn` with method.kind 'linearized'",
    }
    for name, purpose in purposes.items():
        _add_training(commands, name, purpose)
    adapt_options.add_parser(commands)
    experiments_options.add_parser(commands)
    _add_curve(commands)
    _add_average(commands)
    _add_evaluate(commands)
    return parser


def _add_training(commands: Commands, name: str, purpose: str) -> None:
    command = commands.add_parser(name, help=purpose, description=described(purpose))
    add = command.add_argument_group("settings").add_argument
    command.add_argument(
        "config", type=Path, nargs="?", help="YAML file of settings, or a shipped one's name"
    )
    add(
        "--data",
        action="append",
        default=[],
        metavar="[KIND=]PATH",
        help="recording, RGB-D folder, rendered folder or data set; instead of the config's. "
        "With options: '{root: PATH, kind: KIND, OPTION: VALUE}'",
    )
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="override a setting")
    group = command.add_argument_group("run")
    add_out(group, "folder of the run")
    group.add_argument("--resume", action="store_true", help="go on from state.pt in --out")
    group.add_argument("--max-steps", type=at_least_one, metavar="N", help="stop at step N")
    group.add_argument(
        "--dry-run",
        action="store_true",
        help="only tell steps, time of a step and memory on this machine, on made clips (method "
        "unrolled)",
    )


def _add_curve(commands: Commands) -> None:
    purpose = "images seen against error of a run: CSV and PNG"
    command = commands.add_parser("curve", help=purpose, description=described(purpose))
    add = command.add_argument
    add("run", type=Path, help="folder of a run, with its log.jsonl")
    add(
        "--metric",
        action="append",
        default=[],
        metavar="NAME",
        help="a logged metric; may be given several times (default: all)",
    )
    add("--config", type=Path, metavar="FILE", help="the run's config, if its folder has none")
    add("--out", type=Path, metavar="DIR", help="folder for both files (default: the run's)")


def _add_average(commands: Commands) -> None:
    purpose = "mean of the weights of runs with a common start; DyFN is the first's"
    command = commands.add_parser("average", help=purpose, description=described(purpose))
    command.add_argument("models", type=Path, nargs="+", help="checkpoint files")
    command.add_argument(
        "--shares",
        type=float,
        nargs="+",
        metavar="X",
        help="weight of each model, divided by their sum (default: equal)",
    )
    add_out(command, "file to write").metavar = "FILE"


def _add_evaluate(commands: Commands) -> None:
    purpose = "a model and its controls under the image and video protocols"
    command = commands.add_parser("evaluate", help=purpose, description=described(purpose))
    command.add_argument("model", help="bundled name, checkpoint file, or Hub id")
    data = command.add_argument(
        "--data",
        action="append",
        default=[],
        metavar="[KIND=]PATH",
        help="rendered folder, whose held-out clips are scored, or RGB-D folder; may be given "
        "several times",
    )
    renamed(command, "--rendered", data)
    renamed(command, "--recording", data)
    command.add_argument(
        "--clips", type=at_least_one, default=12, metavar="N", help="score N clips (default: 12)"
    )
    add_stride(command)
    command.add_argument(
        "--most-harm",
        type=finite,
        metavar="PERCENT",
        help="exit code 1 where DyFN's video AbsRel is above the base's by more; a negative one "
        "asks for a gain (default: no check)",
    )


if __name__ == "__main__":
    sys.exit(main())
