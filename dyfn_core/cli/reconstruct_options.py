"""The command line of dyfn-eval reconstruct."""

from __future__ import annotations

import argparse

from dyfn_core.argument_types import at_least_one, finite_above_zero, not_negative
from dyfn_core.cli.arguments import Commands
from dyfn_core.cli.data_arguments import add_data_arguments
from dyfn_core.evaluation.choices import CHAINED, OFFSETS, PARTNER_POSES


def add_parser(commands: Commands) -> None:
    """The sub-command and its options; its `run` names the command."""
    command = commands.add_parser(
        "reconstruct",
        help="poses and a fused cloud from predicted point maps",
        description="Poses and a fused cloud, with and without DyFN and from true depth.",
        epilog="Exit status: 0 done, 3 frames could not be read (the rest was used), 2 unusable.",
    )
    add_data_arguments(command)
    add = command.add_argument_group("matching and poses").add_argument
    add(
        "--matcher",
        default="dis+sift",
        help="dis, sift, akaze, orb, or several with + (default: dis+sift)",
    )
    add(
        "--offsets",
        type=at_least_one,
        nargs="+",
        default=list(OFFSETS),
        metavar="N",
        help=f"match with the frames N earlier (default: {' '.join(map(str, OFFSETS))})",
    )
    add(
        "--poses",
        choices=PARTNER_POSES,
        default=CHAINED,
        help="register frames to the found poses of earlier ones, or to their true poses as the "
        "paper does (default: chained)",
    )
    add(
        "--threshold",
        type=finite_above_zero,
        default=0.05,
        metavar="X",
        help="largest residual of an inlier, as a share of its depth (default: 0.05)",
    )
    add("--with-scale", action="store_true", help="similarity instead of rigid poses")
    add("--seed", type=not_negative, default=0, metavar="N", help="seed of RANSAC (default: 0)")
    add = command.add_argument_group("cloud").add_argument
    add(
        "--voxel",
        type=finite_above_zero,
        default=0.01,
        metavar="X",
        help="edge of a voxel, as a share of the first frame's median depth (default: 0.01)",
    )
    add(
        "--tolerance",
        type=finite_above_zero,
        default=0.05,
        metavar="METRES",
        help="distance of a matched point, for precision and recall (default: 0.05)",
    )
    add(
        "--true-depth",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also rebuild from the true depth, as a bound (default: %(default)s)",
    )
    add(
        "--fuse-aligned",
        action="store_true",
        help="find no poses: align depth to the truth per frame and per sequence, and fuse it with "
        "the true poses (figure 2 of the paper)",
    )
    add("--no-model", dest="with_model", action="store_false", help="true depth alone")
    command.set_defaults(run="reconstruct")
