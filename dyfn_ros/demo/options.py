"""The command line of `dyfn-demo`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dyfn_core.argument_types import not_negative
from dyfn_core.cli.arguments import add_max_frames, add_model, command_parser, renamed

DEMO = "bags/demo"
DOMAINS = 100  # DDS domains whose ports are below the ephemeral range


@dataclass(frozen=True)
class DemoOptions:
    """What to play and where to put the results."""

    recording: Path
    out: Path
    model: str = "dyfn-mini"
    max_frames: int | None = None
    domain: int = 1


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(
        "dyfn-demo",
        "Play a recording through the live node over DDS on this machine as the base model, with "
        "DyFN, and, where it holds odometry, with DyFN and metres from the odometry; score what "
        "comes back.",
        "Exit code: 0 done, 1 the node failed, 2 the recording cannot be used.",
    )
    recording = parser.add_argument(
        "recording",
        nargs="?",
        default=argparse.SUPPRESS,  # another default would overwrite what --recording says
        help="rosbag2 folder, .mcap, .db3 or .bag file, RGB-D folder (default: bags/demo, "
        "which is installed too)",
    )
    renamed(parser, "--recording", recording, "RECORDING without an option's name")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        metavar="DIR",
        help="folder for the results (default: out/demo)",
    )
    add_model(parser)
    add_max_frames(parser)
    parser.add_argument(
        "--domain",
        type=not_negative,
        default=1 + os.getpid() % DOMAINS,
        metavar="N",
        help="DDS domain (ROS_DOMAIN_ID) of this run (default: one that follows from the process)",
    )
    return parser


def parse(arguments: Sequence[str] | None = None) -> DemoOptions:
    """Command line -> DemoOptions; ends the process with code 2 on a wrong one."""
    given = vars(parser().parse_args(arguments))
    recording = Path(given.pop("recording", default_recording()))
    return DemoOptions(recording, **given)


def default_recording() -> Path:
    """bags/demo here, else of the source tree or of the installation."""
    above = [Path(), *Path(__file__).resolve().parents]
    places = [place / name for place in above for name in (DEMO, f"share/dyfn_ros/{DEMO}")]
    return next((place for place in places if place.exists()), Path(DEMO))
