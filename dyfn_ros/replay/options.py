"""What `dyfn-replay` can be told."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from dyfn_core.argument_types import above_zero, at_least_one, not_negative
from dyfn_core.evaluation.benchmarks.predictions import QUANTITIES
from dyfn_core.prediction import DEPTH
from dyfn_core.threads import THREADS
from dyfn_ros.recordings.open import image_topics
from dyfn_ros.replay.outputs import DEFAULT, FILES, VOXEL, parse_outputs


@dataclass(frozen=True)
class ReplayOptions:
    """What to replay and how; see the command's --help."""

    recording: Path
    out: Path
    model: str = "dyfn-mini"
    image_topic: str | None = None
    image_topics: tuple[str, ...] = ()  # several: one replay each, see split
    all_topics: bool = False
    camera_info_topic: str | None = None
    depth_topic: str | None = None
    prediction_topic: str | None = None
    quantity: str = DEPTH  # of the prediction topic
    depth_info_topic: str | None = None
    depth_transform: str | None = None
    stamps: Literal["header", "log"] = "header"
    stabilizer: bool = True
    compare: bool = False
    controls: bool = False
    max_frames: int | None = None
    stride: int = 1
    num_tokens: int | None = None
    device: str = "cpu"
    threads: int = THREADS
    depth_max: float = math.inf
    tolerance: float = 0.02
    scene_cut_threshold: float = 0.0
    write: tuple[str, ...] = DEFAULT
    pose_topic: str | None = None
    voxel: float = VOXEL
    progress: bool = True


@dataclass(frozen=True)
class Command:
    """options: of every recording (its own is the first). recordings: as they were given.

    jobs, ray: see fleet.FleetOptions.
    """

    options: ReplayOptions
    recordings: tuple[Path, ...]
    jobs: int
    ray: str | None


def split(options: ReplayOptions) -> list[ReplayOptions]:
    """One Options per image topic when there are several, each with a folder of its own.

    Raises RecordingError as image_topics does.
    """
    topics = options.image_topics
    if options.all_topics:
        topics = tuple(topic for topic in image_topics(options.recording) if topic)
    if not topics:
        return [replace(options, all_topics=False)]
    return [
        replace(
            options,
            image_topic=topic,
            image_topics=(),
            all_topics=False,
            out=options.out / topic.strip("/").replace("/", "_"),
        )
        for topic in topics
    ]


def parse(arguments: Sequence[str] | None = None) -> Command:
    """Command line -> Command; ends the process with code 2 on a wrong one."""
    parser = argparse.ArgumentParser(
        prog="dyfn-replay",
        description="Run recordings through the model, as the node would, and score them.",
        epilog="Exit code: 0 everything was read, 3 part of the recording was damaged and the "
        "rest was used, 2 nothing usable (the reason is on stderr). Of several recordings or "
        "topics: 0 all are whole, 3 some are partial or failed, 2 none gave results.",
    )
    add = parser.add_argument
    add(
        "recordings",
        type=Path,
        nargs="+",
        metavar="recording",
        help="rosbag2 folder, .mcap, .db3 or .bag file, RGB-D folder; several, a folder of them, "
        "or a .txt file that lists them",
    )
    add("--out", type=Path, required=True, help="folder for the results")
    _add_model_options(parser)
    _add_input_options(parser)
    _add_output_options(parser)
    add("--jobs", type=at_least_one, default=1, help="processes for several recordings")
    add("--ray", metavar="ADDRESS", help='Ray cluster for several recordings; "local" makes one')
    given = vars(parser.parse_args(arguments))
    recordings, jobs, ray = (given.pop(name) for name in ("recordings", "jobs", "ray"))
    topics = tuple(given.pop("image_topics"))
    if given["quantity"] is None:
        given["quantity"] = DEPTH
    elif given["prediction_topic"] is None:
        parser.error("--quantity is of --prediction-topic, which is not given")
    if given["prediction_topic"] is not None and given["controls"]:
        parser.error("--controls need a model, --prediction-topic has none")
    if topics and given["all_topics"]:
        parser.error("--all-topics does not go with --image-topic")
    if len(topics) == 1:
        given["image_topic"] = topics[0]
    else:
        given["image_topics"] = topics
    return Command(ReplayOptions(recordings[0], **given), tuple(recordings), jobs, ray)


def _add_model_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--model", default="dyfn-mini", help="bundled name, checkpoint file, or Hub id")
    add("--no-stabilizer", dest="stabilizer", action="store_false", help="the base model alone")
    add("--compare", action="store_true", help="also run the base model, for one report on both")
    add(
        "--controls",
        action="store_true",
        help="also run the model with a moving average of the latent's statistics, and with those "
        "of the first frame, in DyFN's place; each takes as long as the run itself",
    )
    add("--num-tokens", type=at_least_one, help="resolution inside the model")
    add("--device", default="cpu", help="cpu, cuda, cuda:N")
    add(
        "--threads",
        type=not_negative,
        default=THREADS,
        help="CPU threads for inference, on which the result does not depend "
        f"(default: {THREADS}; 0: torch's own choice)",
    )
    add(
        "--scene-cut-threshold",
        type=above_zero,
        default=0.0,
        help="start anew at scene cuts, as the node does (its default: 0.6); by default do not",
    )


def _add_input_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--image-topic",
        dest="image_topics",
        action="append",
        default=[],
        metavar="TOPIC",
        help="colour image, raw or compressed; may be given several times, see --all-topics",
    )
    add(
        "--all-topics",
        action="store_true",
        help="replay every colour image topic, a stream and a folder below --out for each",
    )
    add("--camera-info-topic", help='its CameraInfo; "none" for an unknown camera')
    add(
        "--depth-topic",
        help='ground truth: depth images (16UC1 mm, 32FC1 m, compressed) or a PointCloud2; "none" '
        "for no scores",
    )
    add(
        "--prediction-topic",
        help="score the depth images of this topic, whoever made them, instead of a model's",
    )
    add(
        "--quantity",
        choices=QUANTITIES,
        help="what the prediction topic holds. depth (default); disparity: a / depth + b; "
        "inverse: a / depth",
    )
    add("--depth-info-topic", help="CameraInfo of a depth camera that is not the image's")
    add(
        "--depth-transform",
        metavar="'X Y Z QX QY QZ QW'",
        help="pose of the depth camera or of the cloud's sensor in the image's optical frame",
    )
    add("--depth-max", type=above_zero, default=math.inf, help="cap of the ground truth, metres")
    add("--tolerance", type=above_zero, default=0.02, help="seconds from image to ground truth")
    add(
        "--stamps",
        choices=("header", "log"),
        default="header",
        help="times from the messages' headers, or the times of recording",
    )
    add("--max-frames", type=at_least_one, help="stop after so many frames")
    add("--stride", type=at_least_one, default=1, help="take every N-th frame")


def _add_output_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--write",
        type=_outputs,
        default=DEFAULT,
        metavar="LIST",
        help=f"files beside scores and report: some of {','.join(FILES)}, or none "
        f"(default: {','.join(DEFAULT)})",
    )
    add("--no-output-recording", dest="write", action="store_const", const=(), help="--write none")
    add("--pose-topic", help='poses, odometry or TF for cloud.ply; "none" for no cloud')
    add("--voxel", type=above_zero, default=VOXEL, help="voxels of cloud.ply, metres")


def _outputs(text: str) -> tuple[str, ...]:
    try:
        return parse_outputs(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
