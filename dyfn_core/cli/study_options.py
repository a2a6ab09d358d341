"""The command line of dyfn-eval study."""

from __future__ import annotations

from dyfn_core.argument_types import at_least_one, finite_above_zero
from dyfn_core.cli.arguments import Commands
from dyfn_core.cli.data_arguments import add_data_arguments
from dyfn_core.evaluation.choices import FACTORS

FRAMES = 24


def add_parser(commands: Commands) -> None:
    """The sub-command and its options; its `run` names the command."""
    command = commands.add_parser(
        "study",
        help="scale the latent's statistics and see what moves",
        description="The paper's empirical study on the frames of any data, for any model.",
        epilog="Exit status: 0 done, 3 frames could not be read (the rest was used), 2 unusable.",
    )
    add_data_arguments(command)
    add = command.add_argument_group("study").add_argument
    add(
        "--frames",
        type=at_least_one,
        default=FRAMES,
        metavar="N",
        help=f"study N of the frames, evenly spaced (default: {FRAMES})",
    )
    add(
        "--factors",
        type=finite_above_zero,
        nargs="+",
        default=list(FACTORS),
        metavar="X",
        help="factors of mean and deviation "
        f"(default: {' '.join(f'{factor:g}' for factor in FACTORS)})",
    )
    command.set_defaults(run="study")
