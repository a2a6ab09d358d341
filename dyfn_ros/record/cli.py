"""`dyfn-record`: a recording out of an RGB-D folder or a video file."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import get_args

import numpy as np

from dyfn_core.argument_types import finite_above_zero
from dyfn_core.cli.arguments import add_max_frames, add_out, add_stride, command_parser
from dyfn_ros.record.sources import folder_frames
from dyfn_ros.recordings.camera_yaml import read_camera_yaml
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_writer import ColourEncoding, FrameToRecord, write_rgbd_recording
from dyfn_ros.recordings.typestore import Lens
from dyfn_ros.recordings.video_file import video_frames
from dyfn_ros.recordings.writer import STORAGES, DepthEncoding

ALL, UNUSABLE, PARTIAL = 0, 2, 3  # exit codes, as dyfn-replay's
LENSES = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}


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


def make_recording(options: RecordOptions) -> tuple[int, Counter[str]]:
    """Write the recording; -> frames in it, and what was left out, by reason.

    Raises RecordingError (source, output path, options that do not fit) and OutputError (disk).
    """
    left_out: Counter[str] = Counter()
    frames = islice(_frames(options, left_out), 0, None, options.stride)
    count = write_rgbd_recording(
        options.out,
        islice(frames, options.max_frames),
        storage=options.storage,
        overwrite=options.overwrite,
        namespace=options.namespace.rstrip("/"),
        frame_id=options.frame_id,
        jpeg_quality=options.quality,
        colour=options.colour,
        depth_encoding=options.depth,
    )
    return count, left_out


def _frames(options: RecordOptions, left_out: Counter[str]) -> Iterator[FrameToRecord]:
    def warn(reason: str) -> None:
        left_out[reason] += 1

    source = options.source
    if not source.exists():
        raise RecordingError(f"{source} does not exist; expected an RGB-D folder or a video file")
    if source.is_dir():
        if options.camera_info or options.distortion:
            raise RecordingError(
                f"{source}: --camera-info and --distortion are for videos; depth of a folder is "
                "registered to undistorted images, whose --intrinsics can be given"
            )
        return folder_frames(source, warn, options.rate, options.intrinsics, options.depth_scale)
    if options.depth_scale:
        raise RecordingError(f"{source}: --depth-scale is for folders, not for a video")
    if options.camera_info is not None and (options.intrinsics or options.distortion):
        raise RecordingError("give --camera-info, or --intrinsics and --distortion, not both")
    if options.distortion and not options.intrinsics:
        raise RecordingError("--distortion needs --intrinsics")
    camera = None if options.camera_info is None else read_camera_yaml(options.camera_info)
    return video_frames(source, warn, _matrix(options), _lens(options), camera, options.rate)


def _matrix(options: RecordOptions) -> np.ndarray | None:
    if options.intrinsics is None:
        return None
    fx, fy, cx, cy = options.intrinsics
    if not (fx > 0 and fy > 0):
        raise RecordingError(f"--intrinsics: focal lengths must be above 0, got {fx} and {fy}")
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _lens(options: RecordOptions) -> Lens | None:
    values = options.distortion
    if values is None:
        return None
    if len(values) not in LENSES:
        raise RecordingError(
            f"--distortion: expected {', '.join(map(str, LENSES))} numbers, got {len(values)}"
        )
    return Lens(LENSES[len(values)], values)


def main(arguments: Sequence[str] | None = None) -> int:
    """-> exit code."""
    options = parse(arguments)
    try:
        count, left_out = make_recording(options)
    except (RecordingError, OSError) as error:
        print(f"dyfn-record: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-record: interrupted, nothing was written", file=sys.stderr)
        return 130
    for reason, times in left_out.items():
        print(f"dyfn-record: {reason}{f' ({times} times)' if times > 1 else ''}", file=sys.stderr)
    print(f"{count} frames in {options.out}")
    return PARTIAL if left_out else ALL


if __name__ == "__main__":
    sys.exit(main())
