"""`dyfn-eval`: the command line. It imports no torch before it has read its arguments."""

from __future__ import annotations

import argparse
import sys

from dyfn_core.argument_types import at_least_one
from dyfn_core.cli import reconstruct_options, study_options
from dyfn_core.cli.arguments import Commands, add_strict, command_parser, described
from dyfn_core.cli.eval_arguments import add_benchmark, add_predictions, add_run
from dyfn_core.evaluation.choices import LENGTHS


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parser().parse_args(arguments)  # ends the process for --help and wrong options
    from dyfn_core.cli.eval_commands import execute  # seconds of torch: only now

    return execute(options)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(
        "dyfn-eval",
        "Score a model, or any method's files; rebuild scenes; study the latent.",
        "Exit status: 0 everything was scored; 3 part of the benchmark was missing or could not "
        "be scored, and --allow-missing let the rest go on, or with --strict the scores are hard "
        "to believe; 2 nothing could be scored, or bad "
        "arguments.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_list(commands)
    _add_scored(commands)
    _add_long(commands)
    reconstruct_options.add_parser(commands)
    study_options.add_parser(commands)
    return parser


def _add_list(commands: Commands) -> None:
    text = "print the benchmarks: layout, frames, cap, crop"
    commands.add_parser("list", help=text, description=described(text)).set_defaults(run="list")


def _add_scored(commands: Commands) -> None:
    text = "score a model, with its controls"
    command = commands.add_parser("run", help=text, description=described(text))
    add_benchmark(command)
    add_run(command)
    _add_tables(command)
    text = "score predictions from files"
    command = commands.add_parser("score", help=text, description=described(text))
    add_benchmark(command)
    add_predictions(command)
    _add_tables(command)


def _add_long(commands: Commands) -> None:
    text = "error against length, the alignment solved again at every length"
    command = commands.add_parser("long", help=text, description=described(text))
    add_benchmark(command)
    source = command.add_argument_group("what is scored (one of --model and --predictions)")
    either = source.add_mutually_exclusive_group(required=True)
    add_run(command, either)
    add_predictions(command, either)
    command.add_argument(
        "--lengths",
        type=at_least_one,
        nargs="+",
        metavar="N",
        help=f"frames (default: {' '.join(map(str, LENGTHS))})",
    )
    add_strict(command.add_argument_group("checks"))
    command.set_defaults(run="long")


def _add_tables(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("tables")
    group.add_argument(
        "--temporal",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also compute TAE and flicker (default: %(default)s)",
    )
    add_strict(group)
    group.add_argument("--ablations", action="store_true", help="also print the paper's ablations")
    command.set_defaults(run="score")


if __name__ == "__main__":
    sys.exit(main())
