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
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from dyfn_core.evaluation.pictures import encode_picture
from dyfn_core.evaluation.report import Section, Table, text_table, write_report
from dyfn_core.evaluation.sequence import COLUMNS, SequenceEvaluation, score_table
from dyfn_core.evaluation.sequence_report import sequence_sections
from dyfn_ros.camera_stream import CameraStream, StreamFrame, stream_maker
from dyfn_ros.recordings import RecordedFrame, Recording, RecordingError, open_recording
from dyfn_ros.replay_recording import ReplayRecording
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
    output_recording: bool = True
    compare: bool = False


def parse(arguments: Sequence[str] | None = None) -> Options:
    """Command line -> Options; ends the process with code 2 on a wrong one."""
    parser = argparse.ArgumentParser(
        prog="dyfn-replay",
        description="Run a recording through the model, as the node would, and score it.",
        epilog="Exit code: 0 everything was read, 3 part of the recording was damaged and the "
        "rest was used, 2 nothing usable (the reason is on stderr).",
    )
    add = parser.add_argument
    add("recording", type=Path, help="rosbag2 folder, .mcap or .db3 file, or RGB-D folder")
    add("--out", type=Path, required=True, help="folder for the results")
    add("--model", default="dyfn-mini", help="bundled name, checkpoint file, or Hub id")
    add("--image-topic", help="colour image, raw or compressed")
    add("--camera-info-topic", help='its CameraInfo; "none" for an unknown camera')
    add("--depth-topic", help='ground truth (16UC1 mm or 32FC1 m); "none" for no scores')
    add("--no-stabilizer", dest="stabilizer", action="store_false", help="the base model alone")
    add("--compare", action="store_true", help="also run the base model, for one report on both")
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
    add("--no-output-recording", dest="output_recording", action="store_false")
    return Options(**vars(parser.parse_args(arguments)))


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
    base = _run_base(options, model) if options.compare else None
    return _write_results(options, recording, model, evaluation, base)


def _run_base(options: Options, model: GeometryModel) -> SequenceEvaluation | None:
    """The same frames without DyFN, nothing but their evaluation kept; None without DyFN."""
    if not options.stabilizer or model.stabilizer is None:
        return None
    alone = replace(options, stabilizer=False, output_recording=False)
    recording = open_recording(
        options.recording,
        options.image_topic,
        options.camera_info_topic,
        options.depth_topic,
        options.tolerance,
    )
    return _run(alone, recording, model)


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
    base: SequenceEvaluation | None,
) -> dict[str, Any]:
    results = evaluation.results()
    metrics = {
        "frames": results.pop("frames"),
        "model": options.model,
        "stabilizer": options.stabilizer and model.stabilizer is not None,
        "quantity": model.quantity,
        **results,
        **({} if base is None else {"base": base.results()}),
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
            "depth_max": None if math.isinf(options.depth_max) else options.depth_max,
        },
    }
    strip = evaluation.draw_strip()
    (options.out / "strip.png").write_bytes(encode_picture(strip))
    _write_rows(options.out / "frames.csv", evaluation)
    _write_report(options, metrics, evaluation, base)
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
    options: Options,
    metrics: dict[str, Any],
    evaluation: SequenceEvaluation,
    base: SequenceEvaluation | None,
) -> None:
    facts: list[list[str | float | int | None]] = [
        ["recording", str(options.recording)],
        ["frames", metrics["frames"]],
        ["model", options.model],
        ["DyFN", "on" if metrics["stabilizer"] else "off"],
        ["valid share of the pixels with truth", metrics["coverage"]],
        ["output SHA-256", metrics["output_sha256"][:16]],
        *([topic, value] for topic, value in metrics["recording"]["topics"].items()),
        *([name, value] for name, value in metrics["options"].items() if value is not None),
    ]
    notes = metrics["recording"]["losses"] | metrics["recording"]["warnings"]
    runs = {run_name(metrics): evaluation}
    if base is not None:
        runs[run_name({**metrics, "stabilizer": False})] = base
    sections = sequence_sections(runs)
    if notes:
        rows = [[text, count] for text, count in notes.items()]
        sections.insert(1, Section("Losses and warnings", [Table(("", "times"), rows)]))
    sections.append(Section("What was run", [Table(("", ""), facts)]))
    write_report(options.out / "report.html", f"Replay of {options.recording.name}", sections)


def run_name(metrics: dict[str, Any]) -> str:
    """How a run is called in tables."""
    return f"{metrics['model']}{' with DyFN' if metrics['stabilizer'] else ', base model'}"


def _by_name(metrics: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What was run -> its results."""
    found = {run_name(metrics): metrics}
    if "base" in metrics:
        found[run_name({**metrics, "stabilizer": False})] = metrics["base"]
    return found


def main(arguments: Sequence[str] | None = None, loader: ModelLoader = load) -> int:
    """-> exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    options = parse(arguments)
    try:
        metrics = replay(options, loader)
    except (RecordingError, ValueError, OSError) as error:
        print(f"dyfn-replay: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-replay: interrupted, nothing was written", file=sys.stderr)
        return 130
    notes = metrics["recording"]
    for kind in ("losses", "warnings"):
        for text, count in notes[kind].items():
            times = f" ({count} times)" if count > 1 else ""
            print(
                f"dyfn-replay: {kind[:-1].replace('losse', 'loss')}: {text}{times}", file=sys.stderr
            )
    print(f"{metrics['frames']} frames of {options.recording}")
    print(text_table(score_table(_by_name(metrics))))
    print(f"results in {options.out} (report.html, metrics.json, frames.csv, output.mcap)")
    return PARTIAL if notes["losses"] else ALL


if __name__ == "__main__":
    sys.exit(main())
