"""The command line of `dyfn-record`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from dyfn_core.argument_types import finite_above_zero
from dyfn_core.cli.arguments import add_max_frames, add_out, add_stride, command_parser
from dyfn_ros.recordings.rgbd_writer import ColourEncoding
from dyfn_ros.recordings.writer import STORAGES, DepthEncoding


@dataclass(frozen=True)
class RecordOptions:
    """What to make a recording of and how; see the command's --help."""

    source: Path
    out: Path
    storage: str | None = None
    overwrite: bool = False
    colour: ColourEncoding = "jpeg"
    quality: int = 90
    depth: DepthEncoding = "16UC1"
    intrinsics: tuple[float, float, float, float] | None = None
    distortion: tuple[float, ...] | None = None
    camera_info: Path | None = None
    depth_scale: float | None = None
    rate: float | None = None
    stride: int = 1
    max_frames: int | None = None
    namespace: str = "/camera"
    frame_id: str = "camera_optical"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(
        "dyfn-record",
        "Make a recording out of an RGB-D folder (rgb/ depth/ K.txt, TUM, 7-Scenes, ScanNet "
        "export) or a video file.",
        "Exit code: 0 everything is in it, 3 frames were left out (stderr says which), 2 nothing "
        "was made.",
    )
    parser.add_argument("source", type=Path, help="RGB-D folder or video file")
    _add_output(parser)
    _add_camera(parser)
    group = parser.add_argument_group("frames")
    group.add_argument(
        "--depth-scale",
        type=finite_above_zero,
        metavar="X",
        help="stored depth values per metre (default: by the layout of the folder)",
    )
    group.add_argument(
        "--rate",
        type=finite_above_zero,
        metavar="X",
        help="frames per second, for folders without stamps and videos without times",
    )
    add_stride(group)
    add_max_frames(group)
    return parser


def _add_output(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("recording")
    add_out(group, "rosbag2 folder, or a .mcap or .db3 file").metavar = "PATH"
    add = group.add_argument
    add(
        "--storage",
        choices=sorted(STORAGES),
        help="storage of a rosbag2 folder (default: mcap)",
    )
    add("--overwrite", action="store_true", help="replace what is at --out")
    add(
        "--colour",
        choices=get_args(ColourEncoding),
        default="jpeg",
        help="encoding of the colour images (default: jpeg)",
    )
    add(
        "--quality",
        type=int,
        default=90,
        choices=range(1, 101),
        metavar="1..100",
        help="quality of JPEG (default: 90)",
    )
    add(
        "--depth",
        choices=get_args(DepthEncoding),
        default="16UC1",
        help="encoding of the depth images (default: 16UC1)",
    )
    add("--namespace", default="/camera", help="prefix of the topics (default: /camera)")
    add(
        "--frame-id",
        default="camera_optical",
        help="frame_id of the messages (default: camera_optical)",
    )


def _add_camera(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("camera").add_argument
    add(
        "--intrinsics",
        type=float,
        nargs=4,
        metavar=("FX", "FY", "CX", "CY"),
        help="in pixels, instead of the folder's",
    )
    add(
        "--distortion",
        type=float,
        nargs="+",
        metavar="K",
        help="coefficients of a video's lens: k1 k2 p1 p2 [k3 [k4 k5 k6]]",
    )
    add(
        "--camera-info",
        type=Path,
        metavar="FILE",
        help="calibration of a video's camera: YAML in the ROS format",
    )


def parse(arguments: Sequence[str] | None = None) -> RecordOptions:
    """Command line -> RecordOptions; ends the process with code 2 on a wrong one."""
    given = vars(parser().parse_args(arguments))
    for name in ("intrinsics", "distortion"):
        given[name] = None if given[name] is None else tuple(given[name])
    return RecordOptions(**given)
