"""What the commands share, so that the same thing has the same option and the same words."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

from dyfn_core import __version__
from dyfn_core.argument_types import BACKENDS, at_least_one, device_name, not_negative
from dyfn_core.threads import THREADS

USAGE_ERROR = 2
# What add_argument takes: a parser, or a group of it.
Options = argparse._ActionsContainer
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one line, for the sub-commands as well."""

    def error(self, message: str) -> NoReturn:
        """End the process with exit code 2."""
        self.exit(USAGE_ERROR, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def command_parser(
    prog: str, description: str, epilog: str | None = None
) -> argparse.ArgumentParser:
    """The parser of a command, with --version."""
    parser = CommandParser(prog=prog, description=description, epilog=epilog)
    parser.add_argument(
        "--version",
        action="version",
        version=f"{prog} {__version__}",
        help="print the version and exit",
    )
    return parser


def described(text: str) -> str:
    """The description of a sub-command, from the line that lists it."""
    return f"{text[0].upper()}{text[1:]}."


class _Renamed(argparse.Action):
    """An option under its old name: a warning on stderr, then what the new name does."""

    def __init__(
        self, option_strings: Sequence[str], dest: str, target: argparse.Action, name: str
    ) -> None:
        super().__init__(
            option_strings,
            target.dest,
            nargs=target.nargs,
            default=argparse.SUPPRESS,
            type=None if isinstance(target.type, str) else target.type,
            choices=target.choices,
            help=argparse.SUPPRESS,
        )
        self.target = target
        self.name = name

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        print(f"{parser.prog}: {option_string} is deprecated, use {self.name}", file=sys.stderr)
        self.target.required = False  # it has been given, by its old name
        self.target(parser, namespace, values, self.name)


def renamed(options: Options, old: str, action: argparse.Action, name: str | None = None) -> None:
    """Keep an option's old name working, out of --help, with a warning.

    Args:
        options: where the option is: the parser, or a mutually exclusive group.
        old: the old option string.
        action: the option's action, as add_argument returned it.
        name: the new option string; the first one of the action by default.
    """
    name = name or action.option_strings[0]
    options.add_argument(old, action=_Renamed, target=action, name=name)


def add_model(options: Options, required: bool = False) -> argparse.Action:
    """--model; the bundled one by default."""
    text = "bundled name (dyfn-mini), checkpoint file, or Hub id"
    if required:
        return options.add_argument("--model", required=True, help=text)
    return options.add_argument("--model", default="dyfn-mini", help=f"{text} (default: dyfn-mini)")


def add_device(options: Options) -> None:
    """--device."""
    options.add_argument(
        "--device",
        type=device_name,
        default="auto",
        help="auto (a GPU if there is one), cpu, cuda, cuda:N (default: auto)",
    )


def add_backend(options: Options) -> None:
    """--backend."""
    options.add_argument(
        "--backend",
        choices=BACKENDS,
        default="torch",
        help="library that runs the network; auto: the fastest that is installed "
        "(default: %(default)s)",
    )


def add_threads(options: Options) -> None:
    """--threads."""
    options.add_argument(
        "--threads",
        type=not_negative,
        default=THREADS,
        metavar="N",
        help="CPU threads for inference; the depth does not depend on them; 0: torch's own choice "
        f"(default: {THREADS})",
    )


def add_num_tokens(options: Options) -> None:
    """--num-tokens."""
    options.add_argument(
        "--num-tokens",
        type=_tokens,
        metavar="N",
        help="resolution inside the model: tokens per image; 0: the model's own (default: 0)",
    )


def _tokens(text: str) -> int | None:
    return not_negative(text) or None


def add_stabilize(options: Options) -> None:
    """--stabilize and --no-stabilize; --no-stabilizer until version 1."""
    action = options.add_argument(
        "--stabilize",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="use DyFN; without it the base model runs on every frame by itself "
        "(default: %(default)s)",
    )
    renamed(options, "--no-stabilizer", action, "--no-stabilize")


def add_controls(options: Options, default: bool) -> None:
    """--controls and --no-controls."""
    options.add_argument(
        "--controls",
        action=argparse.BooleanOptionalAction,
        default=default,
        help="also run the two controls in DyFN's place: a moving average of the latent's "
        "statistics, and the first frame's statistics; each takes as long as the run itself "
        "(default: %(default)s)",
    )


def add_start(options: Options) -> argparse.Action:
    """--start."""
    return options.add_argument(
        "--start", type=not_negative, metavar="N", help="first frame, counted from 0"
    )


def add_stride(options: Options, default: int | None = 1) -> argparse.Action:
    """--stride."""
    told = "" if default is None else " (default: %(default)s)"
    return options.add_argument(
        "--stride",
        type=at_least_one,
        default=default,
        metavar="N",
        help=f"take every N-th frame{told}",
    )


def add_strict(options: Options) -> None:
    """--strict."""
    options.add_argument(
        "--strict",
        action="store_true",
        help="end with code 3 when the scores are implausible (the warnings say why)",
    )


def add_max_frames(options: Options) -> argparse.Action:
    """--max-frames."""
    return options.add_argument(
        "--max-frames", type=at_least_one, metavar="N", help="stop after N frames"
    )


def add_out(options: Options, text: str = "folder for the results") -> argparse.Action:
    """--out, which must be given."""
    return options.add_argument("--out", type=Path, required=True, metavar="DIR", help=text)
