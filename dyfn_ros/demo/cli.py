"""`dyfn-demo`: the demo recording through the live node over DDS, with and without DyFN."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from dyfn_core.argument_types import not_negative
from dyfn_core.cli.arguments import add_max_frames, add_model, command_parser, renamed
from dyfn_core.evaluation.report.html import Section, Text, text_table, write_report
from dyfn_core.evaluation.report.pictures import draw_cloud, encode_picture
from dyfn_core.evaluation.report.sequence import sequence_sections
from dyfn_core.evaluation.sequence import SequenceEvaluation, curve_picture, score_table
from dyfn_ros.demo.node_process import NODE_COMMAND, LiveError, NodeProcess
from dyfn_ros.node.environment import prepare_environment
from dyfn_ros.recordings.open import RecordedFrame, Recording, RecordingError, open_recording
from dyfn_ros.recordings.typestore import COMPRESSED_IMAGE

if TYPE_CHECKING:
    from dyfn_ros.demo.live_player import LivePlayer

OK, FAILED, UNUSABLE = 0, 1, 2
RUNS = {"with DyFN": True, "without (base model)": False}
CLOUD_SIZE = (240, 320)
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
        "Play a recording through the live node over DDS on this machine, with and without DyFN, "
        "and score what comes back.",
        "Exit code: 0 done, 1 the node failed, 2 the recording cannot be used.",
    )
    recording = parser.add_argument(
        "recording",
        nargs="?",
        default=argparse.SUPPRESS,  # another default would overwrite what --recording says
        help="rosbag2 folder, .mcap, .db3 or .bag file, RGB-D folder (default: bags/demo of the "
        "source tree)",
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
    """bags/demo here, else in the source tree."""
    here = Path("bags/demo")
    return here if here.exists() else Path(__file__).resolve().parents[2] / here


@dataclass(frozen=True)
class DemoRun:
    """One pass through the node. clouds: pictures of some of the received clouds, side by side."""

    evaluation: SequenceEvaluation
    clouds: np.ndarray


def demo(options: DemoOptions, command: Sequence[str] = NODE_COMMAND) -> dict[str, DemoRun]:
    """Play the recording once per run through one live node and write the report.

    Raises RecordingError (the recording), LiveError (the node), ImportError (no ROS).
    """
    recording = open_recording(options.recording)
    first = next(recording.frames(), None)
    if first is None:
        raise RecordingError(f"{options.recording}: no frame could be read")
    options.out.mkdir(parents=True, exist_ok=True)
    prepare_environment()
    os.environ["ROS_DOMAIN_ID"] = str(options.domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    from dyfn_ros.demo.live_player import LivePlayer

    parameters = {
        "model": options.model,
        "drop_frames": False,
        "reliability": "reliable",  # from the first frame on
        "wait_for_camera_info": first.info is not None,
        "image_transport": "compressed" if first.source.kind == COMPRESSED_IMAGE else "raw",
    }
    namespace = f"/dyfn_demo_{os.getpid()}"  # no other node on the machine is mistaken for ours
    with (
        NodeProcess(options.out / "node.log", parameters, namespace, command) as process,
        LivePlayer(process, first.source.kind, options.domain, namespace) as player,
    ):
        print(f"waiting for the node (model {options.model}) ...", file=sys.stderr)
        player.prime(first)
        runs = {
            name: _run(name, stabilize, player, recording, options.max_frames)
            for name, stabilize in RUNS.items()
        }
    _write(options, recording, runs)
    return runs


def _run(
    name: str, stabilize: bool, player: LivePlayer, recording: Recording, limit: int | None
) -> DemoRun:
    player.reset(stabilize)
    expected = min(recording.expected_frames, limit or recording.expected_frames)
    evaluation = SequenceEvaluation(expected)
    shown = sorted(evaluation.strip.wanted)[1::2]
    clouds: list[np.ndarray] = []
    frames = islice(recording.frames(), limit)
    results = player.play(frames)
    for result in tqdm(results, total=expected, desc=name, unit="frame", file=sys.stderr):
        _check_cloud(result.frame, result.depth, result.cloud)
        if evaluation.frames in shown:
            clouds.append(draw_cloud(*cloud_arrays(result.cloud), CLOUD_SIZE))
        evaluation.push(
            result.frame.image,
            result.depth,
            np.isfinite(result.depth),
            result.frame.depth,
            stamp=result.frame.stamp_ns / 1e9,
            latency=result.latency,
        )
    return DemoRun(evaluation, np.hstack(clouds) if clouds else np.zeros((1, 1, 3), np.uint8))


def cloud_arrays(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H x W of messages.CLOUD_DTYPE -> points H x W x 3 float32, colours H x W x 3 uint8 RGB."""
    packed = np.ascontiguousarray(cloud["rgb"]).view(np.uint32)
    colours = np.stack([packed >> 16, packed >> 8, packed], axis=-1).astype(np.uint8)
    return np.stack([cloud[axis] for axis in "xyz"], axis=-1), colours


def _check_cloud(frame: RecordedFrame, depth: np.ndarray, cloud: np.ndarray) -> None:
    """The cloud must be the depth, point for pixel."""
    if not np.array_equal(cloud["z"], depth, equal_nan=True):
        raise LiveError(f"frame {frame.index}: the cloud's z is not the depth image")


def _write(options: DemoOptions, recording: Recording, runs: dict[str, DemoRun]) -> None:
    evaluations = {name: run.evaluation for name, run in runs.items()}
    results = {name: evaluation.results() for name, evaluation in evaluations.items()}
    out = options.out
    table = score_table(results)
    strips = {name: evaluation.draw_strip() for name, evaluation in evaluations.items()}
    clouds = {name: run.clouds for name, run in runs.items()}
    sections = sequence_sections(evaluations, clouds, LATENCY_NOTE, base=[*RUNS][1])
    if all(result["image"] is not None for result in results.values()):
        (out / "curves.png").write_bytes(encode_picture(curve_picture(evaluations)))
    for name, stabilize in RUNS.items():
        kind = "dyfn" if stabilize else "base"
        (out / f"strip_{kind}.png").write_bytes(encode_picture(strips[name]))
        (out / f"clouds_{kind}.png").write_bytes(encode_picture(runs[name].clouds))
    notes = [*recording.notes.losses, *recording.notes.warnings]
    if len({result["output_sha256"] for result in results.values()}) == 1:
        notes.append(f"{options.model} has no DyFN in it: both runs are the base model's")
    if notes:
        sections.append(Section("Losses and warnings", [Text(note) for note in notes]))
    write_report(out / "report.html", f"{options.model}, live over DDS", sections)
    summary: dict[str, Any] = {"model": options.model, "runs": results}
    (out / "metrics.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(text_table(table))
    for note in notes:
        print(f"note: {note}")
    frames = next(iter(evaluations.values())).frames
    print(f"{frames} frames of {options.recording}, none lost; clouds equal to the depth images")
    print(f"report with pictures: {out / 'report.html'}")


LATENCY_NOTE = " Latency: from publishing the image to receiving its depth, over DDS."


def main(arguments: Sequence[str] | None = None, command: Sequence[str] = NODE_COMMAND) -> int:
    """-> exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    options = parse(arguments)
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the node too
    try:
        demo(options, command)
    except RecordingError as error:
        print(f"dyfn-demo: {error}", file=sys.stderr)
        return UNUSABLE
    except ImportError as error:
        print(
            f"dyfn-demo: ROS 2 is not available ({error}): source its setup file, or install this "
            "package with its `ros` extra",
            file=sys.stderr,
        )
        return FAILED
    except KeyboardInterrupt:
        print("dyfn-demo: interrupted", file=sys.stderr)
        return 130
    except LiveError as error:
        print(f"dyfn-demo: {error}", file=sys.stderr)
        return FAILED
    finally:
        signal.signal(signal.SIGTERM, before)
    return OK


if __name__ == "__main__":
    sys.exit(main())
