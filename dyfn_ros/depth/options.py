"""The command line of `dyfn-depth`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from dyfn_core.argument_types import above_zero, at_least_one, finite_above_zero, image_size
from dyfn_core.cli.arguments import (
    Options,
    add_backend,
    add_device,
    add_max_frames,
    add_model,
    add_num_tokens,
    add_stabilize,
    add_stride,
    add_threads,
    command_parser,
)
from dyfn_core.stream.options import SCALE, STREAM, StreamOptions, add_options, options_of
from dyfn_ros.depth.settings import (
    METRIC_SOURCES,
    PANEL,
    PNG_VALUES,
    RATE,
    WRITE,
    Camera,
    DepthJob,
    Reading,
    Writing,
    parse_write,
)

EPILOG = (
    "Exit code: 0 everything was read (also a camera that Ctrl-C stopped), 2 nothing usable (the "
    "reason is on stderr), 3 part of the source is missing and the rest was used, 130 Ctrl-C "
    "before the end of a file or folder. What was done until then is kept."
)
# Of measurements and poses, which a recording has: dyfn-replay has these options.
_OF_RECORDINGS = ("reference_tolerance", "scale_field")
_WITHOUT = ("stabilize", "num_tokens", "state_file", "metric_source", *_OF_RECORDINGS)


def parse(arguments: Sequence[str] | None = None) -> DepthJob:
    """Read a command line; a wrong one ends the process with code 2.

    Args:
        arguments: Without the program's name; None: those of the process.
    """
    reader = parser()
    given = vars(reader.parse_args(arguments))
    given["num_tokens"] = given["num_tokens"] or 0
    if given["fov"] is not None and given["matrix"] is not None:
        reader.error("--fov and --camera-matrix both give the focal length, expected one of them")
    if None not in (given["near"], given["far"]) and not given["near"] < given["far"]:
        reader.error(f"--near {given['near']:g} --far {given['far']:g}: expected near below far")
    chosen = {name: given[name] for name in options_of(StreamOptions) if name in given}
    if given["metric_source"] == "camera_height" and not given["camera_height"] > 0:
        reader.error("--metric-source camera_height needs --camera-height METRES")
    given["matrix"] = None if given["matrix"] is None else tuple(given["matrix"])
    return DepthJob(
        Reading(**_of(Reading, given)),
        Camera(**_of(Camera, given)),
        Writing(**_of(Writing, given)),
        StreamOptions(**chosen),
        given["model"],
        given["device"],
        given["threads"],
        given["backend"],
    )


def _of(kind: type[Any], given: dict[str, Any]) -> dict[str, Any]:
    """The arguments that are fields of a dataclass."""
    return {one.name: given[one.name] for one in fields(kind)}


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = command_parser(
        "dyfn-depth",
        "Estimate depth of a picture, a folder of pictures, a video, a webcam or a network stream.",
        EPILOG,
    )
    made.add_argument(
        "source",
        help="picture, folder of pictures, video file, webcam (0, /dev/video0), or address "
        "(rtsp://..., http://...)",
    )
    _add_reading(made.add_argument_group("source", "what is read"))
    _add_camera(made.add_argument_group("camera", "what is known of it (default: estimated)"))
    groups = add_options(made, StreamOptions, without=_WITHOUT)
    groups[STREAM].description = "the stream's options, as in the node"
    add_stabilize(groups[STREAM])
    add_num_tokens(groups[STREAM])
    groups[SCALE].add_argument(
        "--metric-source",
        choices=METRIC_SOURCES,
        default="none",
        help="source of metres. none: depth is relative. fixed: --metric-scale. camera_height: "
        "height over the ground. model: what a metric model says. dyfn-replay has those of "
        "recordings (default: none)",
    )
    group = made.add_argument_group("run", "what is run over the frames")
    add_model(group)
    add_device(group)
    add_backend(group)
    add_threads(group)
    _add_writing(made.add_argument_group("outputs", "what is written and shown"))
    return made


def _add_reading(group: Options) -> None:
    group.add_argument(
        "--rate",
        type=finite_above_zero,
        metavar="X",
        help=f"pictures a second of a folder (default: {RATE:g}), or frames a second instead of a "
        "video's own times",
    )
    group.add_argument(
        "--capture-size",
        type=image_size,
        metavar="WIDTHxHEIGHT",
        help="ask a webcam for this size (default: its own)",
    )
    add_stride(group)
    add_max_frames(group)


def _add_camera(group: Options) -> None:
    add = group.add_argument
    add("--fov", type=_degrees, metavar="DEGREES", help="horizontal field of view")
    add(
        "--camera-matrix",
        dest="matrix",
        nargs="+",
        metavar="X",
        help="FX FY CX CY in pixels, nine numbers row by row, or a file: YAML in the ROS format "
        "(whose lens distortion is undone), or text with nine numbers",
    )
    add(
        "--exif",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="use the focal length in the EXIF of pictures (default: %(default)s)",
    )


def _add_writing(group: Options) -> None:
    add = group.add_argument
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for the results (default: the source's; of a camera the working directory)",
    )
    add(
        "--write",
        type=_outputs,
        metavar="LIST",
        help=f"some of {','.join(WRITE)}, or none. video: input and depth (extra `video`); "
        "picture: the same of each frame; png: 16-bit depth; npz: depth, mask, camera; exr: depth "
        "(extra `datasets`); ply: coloured points; rrd: for the Rerun viewer (extra `rerun`) "
        "(default: picture for a picture, else video)",
    )
    add(
        "--view",
        action="store_true",
        help="open the Rerun viewer and show image, depth, points and scale live (extra `rerun`)",
    )
    add(
        "--panels",
        choices=("both", "depth"),
        default="both",
        help="of video and picture. both: input and depth with a scale of the colours; depth: "
        "depth alone (default: both)",
    )
    add("--near", type=finite_above_zero, metavar="X", help="depth of the nearest colour, red")
    add(
        "--far",
        type=finite_above_zero,
        metavar="X",
        help="depth of the farthest colour, blue (default: both follow the scene over 3 s)",
    )
    add(
        "--video-size",
        type=at_least_one,
        default=PANEL,
        metavar="N",
        help=f"longest side of input and depth in video and picture, pixels (default: {PANEL})",
    )
    add(
        "--png-values",
        type=above_zero,
        default=PNG_VALUES,
        metavar="X",
        help="stored values of 16-bit PNGs per unit of depth; 0 is no depth "
        f"(default: {PNG_VALUES:g}: millimetres where depth is in metres)",
    )
    add("--overwrite", action="store_true", help="replace results that are there")


def _degrees(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 180:
        raise argparse.ArgumentTypeError(f"expected degrees between 0 and 180, got {text!r}")
    return value


def _outputs(text: str) -> tuple[str, ...]:
    try:
        return parse_write(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
