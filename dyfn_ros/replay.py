"""`dyfn-replay`: a recording through the same DepthStream as the node, and its scores."""

from __future__ import annotations

import argparse
import csv
import json
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from tqdm import tqdm

from dyfn_core.evaluation.pictures import encode_picture
from dyfn_core.evaluation.report import Picture, Section, Table, Text, text_table, write_report
from dyfn_core.evaluation.sequence import (
    COLUMNS,
    SequenceEvaluation,
    curve_picture,
    score_table,
)
from dyfn_ros.camera_stream import CameraStream, StreamFrame, stream_maker
from dyfn_ros.recordings import (
    RecordedFrame,
    Recording,
    RecordingError,
    image_topics,
    open_recording,
)
from dyfn_ros.replay_recording import ReplayRecording
from dyfn_ros.scene_cut import SceneCutHook
from dyfn_ros.threads import THREADS, computing_threads

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
    image_topics: tuple[str, ...] = ()  # several: one replay each, see split
    all_topics: bool = False
    camera_info_topic: str | None = None
    depth_topic: str | None = None
    depth_info_topic: str | None = None
    depth_transform: str | None = None
    stamps: Literal["header", "log"] = "header"
    stabilizer: bool = True
    max_frames: int | None = None
    stride: int = 1
    num_tokens: int | None = None
    device: str = "cpu"
    threads: int = THREADS
    depth_max: float = math.inf
    tolerance: float = 0.02
    scene_cut_threshold: float = 0.0
    output_recording: bool = True


def parse(arguments: Sequence[str] | None = None) -> Options:
    """Command line -> Options; ends the process with code 2 on a wrong one."""
    parser = argparse.ArgumentParser(
        prog="dyfn-replay",
        description="Run a recording through the model, as the node would, and score it.",
        epilog="Exit code: 0 everything was read, 3 part of the recording was damaged and the "
        "rest was used, 2 nothing usable (the reason is on stderr).",
    )
    add = parser.add_argument
    add("recording", type=Path, help="rosbag2 folder, .mcap, .db3 or .bag file, or RGB-D folder")
    add("--out", type=Path, required=True, help="folder for the results")
    add("--model", default="dyfn-mini", help="bundled name, checkpoint file, or Hub id")
    _add_input_options(parser)
    add("--no-stabilizer", dest="stabilizer", action="store_false", help="the base model alone")
    add("--max-frames", type=_positive, help="stop after so many frames")
    add("--stride", type=_positive, default=1, help="take every N-th frame")
    add("--num-tokens", type=_positive, help="resolution inside the model")
    add("--device", default="cpu", help="cpu, cuda, cuda:N")
    add(
        "--threads",
        type=_count,
        default=THREADS,
        help="CPU threads for inference, to which the last bits of the result belong "
        f"(default: {THREADS}; 0: torch's own choice)",
    )
    add("--depth-max", type=_distance, default=math.inf, help="cap of the ground truth, metres")
    add(
        "--scene-cut-threshold",
        type=_distance,
        default=0.0,
        help="start anew at scene cuts, as the node does (its default: 0.6); by default do not",
    )
    add("--no-output-recording", dest="output_recording", action="store_false")
    found = vars(parser.parse_args(arguments))
    topics = tuple(found.pop("image_topics"))
    if topics and found["all_topics"]:
        parser.error("--all-topics does not go with --image-topic")
    if len(topics) == 1:
        return Options(**found, image_topic=topics[0])
    return Options(**found, image_topics=topics)


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
    add("--depth-info-topic", help="CameraInfo of a depth camera that is not the image's")
    add(
        "--depth-transform",
        metavar="'X Y Z QX QY QZ QW'",
        help="pose of the depth camera or of the cloud's sensor in the image's optical frame",
    )
    add("--tolerance", type=_distance, default=0.02, help="seconds from image to ground truth")
    add(
        "--stamps",
        choices=("header", "log"),
        default="header",
        help="times from the messages' headers, or the times of recording",
    )


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} must not be negative")
    return value


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
    recording = open_recording(
        options.recording,
        options.image_topic,
        options.camera_info_topic,
        options.depth_topic,
        options.tolerance,
        depth_info_topic=options.depth_info_topic,
        depth_transform=options.depth_transform,
        stamps=options.stamps,
    )
    model = loader(options.model, options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    with computing_threads(options.threads) as threads:
        evaluation = _run(options, recording, model)
    if evaluation.frames == 0:
        reasons = "; ".join(recording.notes.losses) or "it holds no frames"
        raise RecordingError(f"{options.recording}: no frame could be used: {reasons}")
    return _write_results(options, recording, model, evaluation, threads)


def split(options: Options) -> list[Options]:
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
    with ExitStack() as stack:
        writer = None
        if options.output_recording:
            writer = stack.enter_context(ReplayRecording(options.out / "output.mcap"))
        for frame in tqdm(frames, total=expected, unit="frame", file=sys.stderr):
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
                said, valid = geometry.depth, geometry.valid
                if geometry.disparity is not None:
                    said, valid = geometry.disparity, np.isfinite(geometry.disparity)
                evaluation.push(
                    frame.image,
                    said,
                    valid,
                    frame.depth,
                    stamp=stamp,
                    latency=latency,
                )
            except ValueError as error:
                raise RecordingError(f"{recording.topics.depth}: {error}") from error
            if writer is not None:
                writer.write(frame, geometry)
    return evaluation


def _write_results(
    options: Options,
    recording: Recording,
    model: GeometryModel,
    evaluation: SequenceEvaluation,
    threads: int,
) -> dict[str, Any]:
    results = evaluation.results()
    metrics = {
        "frames": results.pop("frames"),
        "model": options.model,
        "stabilizer": options.stabilizer and model.stabilizer is not None,
        "quantity": model.quantity,
        **results,
        "recording": {
            "path": str(options.recording),
            "topics": vars(recording.topics),
            "losses": dict(recording.notes.losses),
            "warnings": dict(recording.notes.warnings),
        },
        "options": {
            "stride": options.stride,
            "max_frames": options.max_frames,
            "num_tokens": options.num_tokens,
            "scene_cut_threshold": options.scene_cut_threshold,
            "stamps": options.stamps,
            "tolerance": options.tolerance,
            "depth_transform": options.depth_transform,
            "threads": threads,
            "depth_max": None if math.isinf(options.depth_max) else options.depth_max,
        },
    }
    strip = evaluation.draw_strip()
    (options.out / "strip.png").write_bytes(encode_picture(strip))
    _write_rows(options.out / "frames.csv", evaluation)
    _write_report(options, metrics, evaluation, Picture(strip, "input, truth, depth, error"))
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    partial = options.out / "metrics.json.partial"
    partial.write_text(text, encoding="utf-8")
    partial.replace(options.out / "metrics.json")
    return metrics


def _write_rows(path: Path, evaluation: SequenceEvaluation) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(evaluation.rows())


def _write_report(
    options: Options, metrics: dict[str, Any], evaluation: SequenceEvaluation, strip: Picture
) -> None:
    name = run_name(metrics)
    facts: list[list[str | float | int | None]] = [
        ["recording", str(options.recording)],
        ["frames", metrics["frames"]],
        ["model", options.model],
        ["DyFN", "on" if metrics["stabilizer"] else "off"],
        ["valid share of the pixels with truth", metrics["coverage"]],
        ["latency p99, ms", metrics["latency_ms"]["p99"]],
        ["output SHA-256", metrics["output_sha256"][:16]],
        *([topic, value] for topic, value in metrics["recording"]["topics"].items()),
    ]
    notes = metrics["recording"]["losses"] | metrics["recording"]["warnings"]
    sections = [
        Section("Scores", [score_table({name: metrics}), Text(SCORE_NOTE, note=True)]),
        Section("Frames", [strip]),
    ]
    if metrics["image"] is not None:
        curves = Picture(curve_picture({name: evaluation}), "scale and error", photographic=False)
        sections.append(Section("Over time", [curves]))
    if notes:
        rows = [[text, count] for text, count in notes.items()]
        sections.append(Section("Losses and warnings", [Table(("", "times"), rows)]))
    sections.append(Section("What was run", [Table(("", ""), facts)]))
    write_report(options.out / "report.html", f"Replay of {options.recording.name}", sections)


SCORE_NOTE = (
    "AbsRel: mean |d - p| / d, lower is better. delta1: share within 25%, higher is better. "
    "Image: each frame aligned to the truth by its own scale and shift; video: one scale and "
    "shift for the whole sequence. Scale spread: standard deviation of the log of each frame's "
    "own scale. The controls know nothing of the image: a vertical ramp and a constant."
)


def run_name(metrics: dict[str, Any]) -> str:
    """How a run is called in tables."""
    return f"{metrics['model']}{' with DyFN' if metrics['stabilizer'] else ', base model'}"


def main(arguments: Sequence[str] | None = None, loader: ModelLoader = load) -> int:
    """-> exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    options = parse(arguments)
    try:
        codes = [_replay_and_tell(one, loader) for one in split(options)]
    except RecordingError as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-replay: interrupted, nothing was written", file=sys.stderr)
        return 130
    if len(set(codes)) == 1:
        return codes[0]
    return PARTIAL  # of several topics, some were damaged or unusable


def _replay_and_tell(options: Options, loader: ModelLoader) -> int:
    try:
        metrics = replay(options, loader)
    except (RecordingError, ValueError, OSError) as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    notes = metrics["recording"]
    for kind in ("losses", "warnings"):
        for text, count in notes[kind].items():
            times = f" ({count} times)" if count > 1 else ""
            print(
                f"dyfn-replay: {kind[:-1].replace('losse', 'loss')}: {text}{times}", file=sys.stderr
            )
    print(f"{metrics['frames']} frames of {options.recording}")
    print(text_table(score_table({run_name(metrics): metrics})))
    print(f"results in {options.out} (report.html, metrics.json, frames.csv, output.mcap)")
    return PARTIAL if notes["losses"] else ALL


if __name__ == "__main__":
    sys.exit(main())
