"""The command line of dyfn-train experiments."""

from __future__ import annotations

from pathlib import Path

from dyfn_core.argument_types import at_least_one
from dyfn_core.cli.arguments import Commands, add_stride, described, renamed

LENGTHS = (100, 200, 300, 400, 500)
CONFIG = Path("config/train_experiments.yaml")
OUT = Path("runs/experiments")


def add_parser(commands: Commands) -> None:
    """The sub-command and its options."""
    text = "the paper's claims, on a base of your own"
    command = commands.add_parser("experiments", help=text, description=described(text))
    add = command.add_argument
    add("name", nargs="*", help="experiments to run (default: all); see --list")
    add("--list", action="store_true", help="print the experiments and stop")
    add(
        "--config",
        type=Path,
        default=CONFIG,
        metavar="FILE",
        help=f"settings of every run (default: {CONFIG})",
    )
    add("--base", metavar="MODEL", help="model whose DyFN is trained, instead of the config's")
    add(
        "--out",
        type=Path,
        default=OUT,
        metavar="DIR",
        help=f"folder for all runs (default: {OUT})",
    )
    add("--seeds", type=at_least_one, default=3, metavar="N", help="runs per arm (default: 3)")
    add("--write", type=Path, metavar="FILE", help="Markdown file to put the tables in")
    data = add(
        "--data",
        dest="recording",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="RGB-D folder to score on; may be given several times",
    )
    renamed(command, "--recording", data)
    add(
        "--clips",
        type=at_least_one,
        default=12,
        metavar="N",
        help="held-out clips to score on (default: 12)",
    )
    add_stride(command, 4)
    add(
        "--lengths",
        type=at_least_one,
        nargs="+",
        default=list(LENGTHS),
        metavar="N",
        help=f"frames, for long-sequences (default: {' '.join(map(str, LENGTHS))})",
    )
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="override a setting")
