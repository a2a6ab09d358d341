"""`dyfn-replay`: a recording through the same DepthStream as the node, and its scores."""

from __future__ import annotations

import argparse
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from dyfn_core.evaluation.report import text_table
from dyfn_core.evaluation.sequence import SequenceEvaluation, score_table
from dyfn_ros.camera_stream import CameraStream, StreamFrame, stream_maker
from dyfn_ros.recordings import RecordedFrame, Recording, RecordingError, open_recording
from dyfn_ros.replay_outputs import (
    DEFAULT,
    FILES,
    VOXEL,
    OutputOptions,
    ReplayOutputs,
    parse_outputs,
)
from dyfn_ros.replay_results import run_name, write_results
from dyfn_ros.replay_video import Alignment
from dyfn_ros.scene_cut import SceneCutHook

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel

ALL, UNUSABLE, PARTIAL = 0, 2, 3  # exit codes; argparse also ends with 2
ModelLoader = Callable[[str, str], "GeometryModel"]


@dataclass(frozen=True)
class Options:
    """What to replay and how; see the command's --help."""

    recording: Path
    out: Path
    model: str = "dyfn-mini"
    image_topic: str | None = None
    camera_info_topic: str | None = None
    depth_topic: str | None = None
    stabilizer: bool = True
    max_frames: int | None = None
    stride: int = 1
    num_tokens: int | None = None
    device: str = "cpu"
    threads: int | None = None
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

    options: Options
    recordings: tuple[Path, ...]
    jobs: int
    ray: str | None


def parse(arguments: Sequence[str] | None = None) -> Command:
    """Command line -> Command; ends the process with code 2 on a wrong one."""
    parser = argparse.ArgumentParser(
        prog="dyfn-replay",
        description="Run recordings through the model, as the node would, and score them.",
        epilog="Exit code: 0 everything was read, 3 part of the recording was damaged and the "
        "rest was used, 2 nothing usable (the reason is on stderr). Of several recordings: 0 all "
        "are whole, 3 some are partial or failed, 2 none gave results.",
    )
    add = parser.add_argument
    add(
        "recordings",
        type=Path,
        nargs="+",
        metavar="recording",
        help="rosbag2 folder, .mcap or .db3 file, RGB-D folder; several, a folder of them, or a "
        ".txt file that lists them",
    )
    add("--out", type=Path, required=True, help="folder for the results")
    add("--model", default="dyfn-mini", help="bundled name, checkpoint file, or Hub id")
    add("--image-topic", help="colour image, raw or compressed")
    add("--camera-info-topic", help='its CameraInfo; "none" for an unknown camera')
    add("--depth-topic", help='ground truth (16UC1 mm or 32FC1 m); "none" for no scores')
    add("--no-stabilizer", dest="stabilizer", action="store_false", help="the base model alone")
    add("--max-frames", type=_positive, help="stop after so many frames")
    add("--stride", type=_positive, default=1, help="take every N-th frame")
    add("--num-tokens", type=_positive, help="resolution inside the model")
    add("--device", default="cpu", help="cpu, cuda, cuda:N")
    add("--threads", type=_positive, help="CPU threads for inference")
    add("--depth-max", type=_distance, default=math.inf, help="cap of the ground truth, metres")
    add("--tolerance", type=_distance, default=0.02, help="seconds from image to ground truth")
    add(
        "--scene-cut-threshold",
        type=_distance,
        default=0.0,
        help="start anew at scene cuts, as the node does (its default: 0.6); by default do not",
    )
    _add_output_options(parser)
    add("--jobs", type=_positive, default=1, help="processes for several recordings")
    add("--ray", metavar="ADDRESS", help='Ray cluster for several recordings; "local" makes one')
    given = vars(parser.parse_args(arguments))
    recordings, jobs, ray = (given.pop(name) for name in ("recordings", "jobs", "ray"))
    return Command(Options(recordings[0], **given), tuple(recordings), jobs, ray)


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
    add("--voxel", type=_distance, default=VOXEL, help="voxels of cloud.ply, metres")


def _outputs(text: str) -> tuple[str, ...]:
    try:
        return parse_outputs(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} must be at least 1")
    return value


def _distance(text: str) -> float:
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text} must be above 0")
    return value


def load(name: str, device: str) -> GeometryModel:
    """load_model, imported when it is needed: torch takes seconds that --help should not."""
    from dyfn_core.models import load_model

    return load_model(name, device=device)


def replay(options: Options, loader: ModelLoader = load) -> dict[str, Any]:
    """Replay a recording and write everything into options.out; returns metrics.json's content.

    Raises RecordingError for a recording that cannot be used, and what load_model raises.
    """
    if options.threads is not None:
        import torch

        torch.set_num_threads(options.threads)
    recording = open_recording(
        options.recording,
        options.image_topic,
        options.camera_info_topic,
        options.depth_topic,
        options.tolerance,
    )
    model = loader(options.model, options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    evaluation = _run(options, recording, model)
    if evaluation.frames == 0:
        reasons = "; ".join(recording.notes.losses) or "it holds no frames"
        raise RecordingError(f"{options.recording}: no frame could be used: {reasons}")
    return write_results(options, recording, model, evaluation)


def _frames(options: Options, recording: Recording) -> tuple[Iterator[RecordedFrame], int]:
    """The frames to use, and how many there will be if none is lost."""
    available = math.ceil(recording.expected_frames / options.stride)
    expected = min(available, options.max_frames or available)
    frames = islice(recording.frames(), 0, None, options.stride)
    return islice(frames, options.max_frames), expected


def _run(options: Options, recording: Recording, model: GeometryModel) -> SequenceEvaluation:
    cuts = SceneCutHook(lambda: options.scene_cut_threshold)
    camera = CameraStream(stream_maker(model), hooks=[cuts])
    frames, expected = _frames(options, recording)
    evaluation = SequenceEvaluation(expected, options.depth_max, model.quantity)
    with _outputs_of(options, recording) as outputs:
        for frame in tqdm(
            frames, total=expected, unit="frame", file=sys.stderr, disable=not options.progress
        ):
            start = time.perf_counter()
            seconds, nanoseconds = divmod(frame.stamp_ns, 1_000_000_000)
            stamp = seconds + nanoseconds * 1e-9
            geometry = camera.push(
                StreamFrame(
                    frame.image,
                    frame.camera_matrix,
                    visible=frame.visible,
                    stamp=stamp,
                    frame_id=frame.frame_id,
                    stabilize=options.stabilizer,
                    num_tokens=options.num_tokens or 0,
                )
            )
            latency = time.perf_counter() - start
            try:
                # Disparity is aligned as such, also where its inverse is too far to be depth.
                score = evaluation.push(
                    frame.image,
                    *geometry.said,
                    frame.depth,
                    stamp=stamp,
                    latency=latency,
                )
            except ValueError as error:
                raise RecordingError(f"{recording.topics.depth}: {error}") from error
            outputs.write(frame, geometry, score)
        video, quantity = evaluation.video(), model.quantity
        alignment = None if video is None else Alignment(video.scale, video.shift, quantity)
        outputs.finish(alignment, quantity)
    return evaluation


def _outputs_of(options: Options, recording: Recording) -> ReplayOutputs:
    chosen = OutputOptions(options.write, options.pose_topic, options.voxel, options.depth_max)

    def warn(reason: str) -> None:
        recording.notes.warnings[reason] += 1

    return ReplayOutputs(options.out, options.recording, chosen, warn)


def main(arguments: Sequence[str] | None = None, loader: ModelLoader = load) -> int:
    """-> exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    command = parse(arguments)
    try:
        return _replay_command(command, loader)
    except (RecordingError, ValueError, OSError) as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-replay: interrupted, unfinished results were not written", file=sys.stderr)
        return 130


def _replay_command(command: Command, loader: ModelLoader) -> int:
    from dyfn_ros import fleet  # which is above this module

    options = command.options
    if fleet.is_many(command.recordings):
        chosen = fleet.FleetOptions(command.jobs, command.ray)
        return fleet.replay_all(fleet.expand(command.recordings), options, chosen, loader)
    metrics = replay(options, loader)
    notes = metrics["recording"]
    for kind in ("losses", "warnings"):
        for text, count in notes[kind].items():
            times = f" ({count} times)" if count > 1 else ""
            print(
                f"dyfn-replay: {kind[:-1].replace('losse', 'loss')}: {text}{times}", file=sys.stderr
            )
    print(f"{metrics['frames']} frames of {options.recording}")
    print(text_table(score_table({run_name(metrics): metrics})))
    written = [name for name in FILES.values() if (options.out / name).exists()]
    listed = ", ".join(["report.html", "metrics.json", "frames.csv", *written])
    print(f"results in {options.out}: {listed}")
    return PARTIAL if notes["losses"] else ALL


if __name__ == "__main__":
    sys.exit(main())
