"""The command line of `dyfn-replay`."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from dyfn_core.argument_types import above_zero, at_least_one, finite, finite_above_zero
from dyfn_core.cli.arguments import (
    Options,
    add_backend,
    add_controls,
    add_device,
    add_max_frames,
    add_model,
    add_num_tokens,
    add_out,
    add_stabilize,
    add_strict,
    add_stride,
    add_threads,
    command_parser,
)
from dyfn_core.metric.odometry_noise import OdometryNoise, parse_noise
from dyfn_core.quantities import DEPTH, QUANTITIES
from dyfn_core.stream.options import STREAM, add_options, options_from
from dyfn_ros.replay.settings import (
    DEFAULT,
    FILES,
    VOXEL,
    BatchOptions,
    Outputs,
    PredictionTopic,
    ReplayJob,
    Run,
    SessionOptions,
    Source,
    TopicChoice,
    parse_outputs,
)

EPILOG = (
    "Exit code: 0 everything was read, 3 part of the recording was damaged and the rest was used "
    "(with --strict also: the scores are implausible), "
    "2 nothing usable (the reason is on stderr). Of several recordings or topics: 0 all are whole, "
    "3 some are partial or failed, 2 none gave results."
)


@dataclass(frozen=True)
class Command:
    """A command line.

    Attributes:
        recordings: As they were given.
        job: What every recording is replayed with; its source reads the first.
        topics: Image topics of each recording.
        batch: How several recordings are replayed.
    """

    recordings: tuple[Path, ...]
    job: ReplayJob
    topics: TopicChoice
    batch: BatchOptions


def parse(arguments: Sequence[str] | None = None) -> Command:
    """Read a command line; a wrong one ends the process with code 2.

    Args:
        arguments: Without the program's name; None: those of the process.

    Returns:
        What it asks for.
    """
    reader = parser()
    given = vars(reader.parse_args(arguments))
    given["num_tokens"] = given["num_tokens"] or 0
    recordings, names = tuple(given["recordings"]), tuple(given["image_topics"])
    run = Run(stream=options_from(given, SessionOptions), **_of(Run, given))
    _check(reader, given, run)
    topic = given["prediction_topic"]
    scored = None if topic is None else PredictionTopic(topic, given["quantity"] or DEPTH)
    alone = names[0] if len(names) == 1 else None
    source = Source(recording=recordings[0], image_topic=alone, **_of(Source, given))
    outputs = Outputs(given["out"], **_of(Outputs, given))
    job = ReplayJob(source, scored or run, outputs, given["strict"])
    topics = TopicChoice(() if alone else names, given["all_topics"])
    return Command(recordings, job, topics, BatchOptions(**_of(BatchOptions, given)))


def _of(kind: type[Any], given: dict[str, Any]) -> dict[str, Any]:
    """The arguments that are fields of a dataclass."""
    return {one.name: given[one.name] for one in fields(kind) if one.name in given}


def _check(reader: argparse.ArgumentParser, given: dict[str, Any], run: Run) -> None:
    """Refuse contradictions, and name options that have no effect."""
    if given["image_topics"] and given["all_topics"]:
        reader.error("--all-topics does not go with --image-topic")
    _check_session(reader, given, run)
    if given["prediction_topic"] is None:
        if given["quantity"] is not None:
            reader.error("--quantity describes --prediction-topic, which is not given")
        if run.compare and not run.stream.stabilize and run.without_odometry() is None:
            reader.error("--compare has no effect with --no-stabilize: both runs are the same")
        return
    for name in ("compare", "controls"):
        if given[name]:
            reader.error(f"--{name} needs a model, and --prediction-topic runs none")
    names = {one.name for kind in (Run, SessionOptions) for one in fields(kind)} & given.keys()
    usual = vars(parser().parse_args(["-", "--out", "-"]))
    usual["num_tokens"] = 0
    idle = sorted(name for name in names if given[name] != usual[name])
    if idle:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in idle)
        text = f"{options}: no effect with --prediction-topic, which runs no model"
        print(f"{reader.prog}: warning: {text}", file=sys.stderr)


def _check_session(reader: argparse.ArgumentParser, given: dict[str, Any], run: Run) -> None:
    stream, saved = run.stream, run.load_state or run.save_state
    if given["reference_topic"] is not None and stream.metric_source != "reference":
        reader.error("--reference-topic has no effect without --metric-source reference")
    if stream.metric_source != "odometry":
        for name in ("odometry_topic", "odometry_offset", "odometry_noise"):
            if given[name]:
                option = f"--{name.replace('_', '-')}"
                reader.error(f"{option} has no effect without --metric-source odometry")
    if saved and not stream.state_file:
        reader.error("--load-state and --save-state need --state-file")
    if stream.state_file and not saved:
        reader.error("--state-file has no effect without --load-state or --save-state")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = command_parser(
        "dyfn-replay",
        "Run recordings through the model, as the node would, and score them.",
        EPILOG,
    )
    made.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="recording",
        help="rosbag2 folder, .mcap, .db3 or .bag file, RGB-D folder, video, folder of pictures; "
        "several, a folder of them, or a .txt file that lists them",
    )
    _add_source(made.add_argument_group("source", "what is read of a recording"))
    stream = add_options(made, SessionOptions, without=("stabilize", "num_tokens"))[STREAM]
    stream.description = "the stream's options, with the node's names and defaults"
    add_stabilize(stream)
    add_num_tokens(stream)
    _add_state(stream)
    _add_run(made.add_argument_group("run", "what is run over the frames"))
    _add_outputs(made.add_argument_group("outputs", "what is scored and written"))
    _add_batch(made.add_argument_group("batch", "how several recordings are replayed"))
    return made


def _add_source(group: Options) -> None:
    add = group.add_argument
    add(
        "--image-topic",
        dest="image_topics",
        action="append",
        default=[],
        metavar="TOPIC",
        help="colour image, raw or compressed; may be given several times, see --all-topics "
        "(default: found by type)",
    )
    add(
        "--all-topics",
        action="store_true",
        help="replay every colour image topic, a stream and a folder below --out for each",
    )
    add(
        "--camera-info-topic",
        metavar="TOPIC",
        help='its CameraInfo; "none" for unknown intrinsics (default: found by type)',
    )
    add(
        "--image-bits",
        type=int,
        choices=range(8, 17),
        default=16,
        metavar="BITS",
        help="bits that the values of 16-bit encodings (mono16, bayer_rggb16, ...) have, 8 to 16: "
        "12 for a camera of 12 bits whose values are not shifted up (default: 16)",
    )
    add(
        "--depth-topic",
        metavar="TOPIC",
        help='ground truth: depth images (16UC1 mm, 32FC1 m, compressed) or a PointCloud2; "none" '
        "for no scores (default: found by type, depth images only)",
    )
    add(
        "--depth-info-topic",
        metavar="TOPIC",
        help="CameraInfo of a depth camera that is not the image's",
    )
    add(
        "--depth-transform",
        metavar="'X Y Z QX QY QZ QW'",
        help="pose of the depth camera or of the cloud's sensor in the image's optical frame, "
        "metres",
    )
    add(
        "--depth-scale",
        type=finite_above_zero,
        metavar="X",
        help="stored depth values per metre (default: 1000 for 16UC1, 1 for 32FC1 and clouds, of a "
        "folder by its layout)",
    )
    add(
        "--depth-offset",
        type=finite,
        default=0.0,
        metavar="SECONDS",
        help="how much the depth's stamps are after those of images of the same moment, negative "
        "for before (default: 0)",
    )
    add(
        "--tolerance",
        type=above_zero,
        default=0.02,
        metavar="SECONDS",
        help="largest difference of the stamps of an image and its ground truth (default: 0.02)",
    )
    add(
        "--stamps",
        choices=("header", "log"),
        default="header",
        help="times of the messages' headers, or times of recording (default: header)",
    )
    add(
        "--reference-topic",
        metavar="TOPIC",
        help="measurements for --metric-source reference (default: found by --reference-type)",
    )
    add(
        "--odometry-topic",
        metavar="TOPIC",
        help="poses, odometry or TF for --metric-source odometry (default: found by type; "
        "poses.txt of a folder)",
    )
    add(
        "--odometry-offset",
        type=finite,
        default=0.0,
        metavar="SECONDS",
        help="how much the odometry's stamps are after those of images of the same moment, "
        "negative for before (default: 0)",
    )
    add(
        "--odometry-noise",
        type=_noise,
        metavar="SCALE,DISTANCE,ROTATION,SEED",
        help="for tests: errors added to these poses, such as 0.02,0.01,0.2,0: scale, random walk "
        "of the distance, degrees per square root of a metre (default: none)",
    )
    add_stride(group)
    add_max_frames(group)


def _add_state(group: Options) -> None:
    add = group.add_argument
    add("--load-state", action="store_true", help="go on from the state in --state-file")
    add(
        "--save-state",
        action="store_true",
        help="save the state after the last frame to --state-file",
    )


def _add_run(group: Options) -> None:
    add = group.add_argument
    add_model(group)
    add_device(group)
    add_backend(group)
    add_threads(group)
    add(
        "--compare",
        action="store_true",
        help="also run the base model, and DyFN without odometry, for one report on all",
    )
    add_controls(group, default=False)
    add(
        "--prediction-topic",
        metavar="TOPIC",
        help="run no model: score the depth images of this topic, whoever made them",
    )
    add(
        "--quantity",
        choices=QUANTITIES,
        help="what the prediction topic holds. depth (default); disparity: a / depth + b; "
        "inverse: a / depth",
    )


def _add_outputs(group: Options) -> None:
    add = group.add_argument
    add_out(group)
    add(
        "--write",
        type=_outputs,
        default=DEFAULT,
        metavar="LIST",
        help=f"files beside scores and report: some of {','.join(FILES)}, or none; raw: "
        "output.mcap with depth that is not compressed "
        "(default: mcap,ply, and video where the extra `video` is installed)",
    )
    add("--no-output-recording", dest="write", action="store_const", const=(), help="--write none")
    add(
        "--pose-topic",
        metavar="TOPIC",
        help='poses, odometry or TF for cloud.ply; "none" for no cloud (default: found by type)',
    )
    add(
        "--pose-offset",
        type=finite,
        default=0.0,
        metavar="SECONDS",
        help="how much the stamps of --pose-topic are after those of images of the same moment, "
        "negative for before (default: 0)",
    )
    add(
        "--voxel",
        type=above_zero,
        default=VOXEL,
        metavar="METRES",
        help=f"edge of a voxel of cloud.ply (default: {VOXEL})",
    )
    add(
        "--depth-max",
        type=above_zero,
        default=math.inf,
        metavar="METRES",
        help="leave out ground truth and points of cloud.ply beyond this depth (default: none)",
    )
    add_strict(group)


def _add_batch(group: Options) -> None:
    add = group.add_argument
    add(
        "--jobs",
        type=at_least_one,
        default=1,
        metavar="N",
        help="worker processes (default: 1)",
    )
    add(
        "--ray",
        metavar="ADDRESS",
        help='send the recordings to this Ray cluster; "local" makes one on this machine',
    )


def _noise(text: str) -> OdometryNoise:
    try:
        return parse_noise(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _outputs(text: str) -> tuple[str, ...]:
    try:
        return parse_outputs(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
