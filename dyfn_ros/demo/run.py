"""A recording through the live node over DDS: base, DyFN, DyFN + odometry."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from dyfn_core.evaluation.report.html import Section, Text, text_table, write_report
from dyfn_core.evaluation.report.pictures import draw_cloud, encode_picture
from dyfn_core.evaluation.report.sequence import sequence_sections, variants_of
from dyfn_core.evaluation.report.variants import headline
from dyfn_core.evaluation.sequence import SequenceEvaluation, curve_picture, score_table
from dyfn_ros.demo.node_process import NODE_COMMAND, LiveError, NodeProcess
from dyfn_ros.demo.odometry import RecordedOdometry, read_odometry
from dyfn_ros.demo.options import DemoOptions
from dyfn_ros.node.environment import prepare_environment
from dyfn_ros.recordings.open import RecordedFrame, Recording, RecordingError, open_recording
from dyfn_ros.recordings.typestore import COMPRESSED_IMAGE

if TYPE_CHECKING:
    from dyfn_ros.demo.live_player import LivePlayer

BASE, DYFN, MOVING = "base", "DyFN", "DyFN + odometry"
FILES = {BASE: "base", DYFN: "dyfn", MOVING: "odometry"}  # in the order of the table
POSE_PATIENCE = 1.0  # seconds that the node waits for the pose of an image
CLOUD_SIZE = (240, 320)


@dataclass(frozen=True)
class DemoRun:
    """One pass through the node.

    clouds: pictures of some of the received clouds, side by side. answered: indices of the frames
    whose depth had a valid pixel.
    """

    evaluation: SequenceEvaluation
    clouds: np.ndarray
    answered: frozenset[int]


def demo(options: DemoOptions, command: Sequence[str] = NODE_COMMAND) -> dict[str, DemoRun]:
    """Play the recording once per run through a live node and write the report.

    With odometry that run is the first, and frames for which it has no depth yet (metres are
    withheld until they are known) are scored in no run; where it has none at all, it alone is not
    scored.

    Raises RecordingError (the recording), LiveError (the node), ImportError (no ROS).
    """
    recording = open_recording(options.recording)
    first = next(recording.frames(), None)
    if first is None:
        raise RecordingError(f"{options.recording}: no frame could be read")
    odometry, why = read_odometry(options.recording, first.frame_id)
    options.out.mkdir(parents=True, exist_ok=True)
    prepare_environment()
    os.environ["ROS_DOMAIN_ID"] = str(options.domain)
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    stage = _Stage(options, recording, first, command)
    runs: dict[str, DemoRun] = {}
    if odometry is not None:
        runs |= stage.play({MOVING: True}, odometry)
    scored = (runs[MOVING].answered or None) if runs else None
    runs |= stage.play({DYFN: True, BASE: False}, scored=scored)
    notes = [] if odometry is not None else [f"two runs only: {why}"]
    _write(options, recording, runs, notes)
    return runs


@dataclass(frozen=True)
class _Stage:
    """What all runs share."""

    options: DemoOptions
    recording: Recording
    first: RecordedFrame
    command: Sequence[str]

    def play(
        self,
        runs: dict[str, bool],
        odometry: RecordedOdometry | None = None,
        scored: frozenset[int] | None = None,
    ) -> dict[str, DemoRun]:
        """Runs (name -> whether with DyFN) through one node.

        odometry: where metres come from. scored: the frames that count; None for all that have
        truth and an answer.
        """
        from dyfn_ros.demo.live_player import LivePlayer

        options, kind = self.options, self.first.source.kind
        parameters = {
            "model": options.model,
            "drop_frames": False,
            "reliability": "reliable",  # from the first frame on
            "wait_for_camera_info": self.first.info is not None,
            "image_transport": "compressed" if kind == COMPRESSED_IMAGE else "raw",
        }
        if odometry is not None:
            parameters |= {
                "metric_source": "odometry",
                "odometry_wait": POSE_PATIENCE,
                "camera_pose": odometry.camera_pose,
            }
        # no other node on the machine is mistaken for ours
        namespace = f"/dyfn_demo_{os.getpid()}_{len(runs)}"
        log = options.out / ("node.log" if odometry is None else "node_odometry.log")
        with (
            NodeProcess(log, parameters, namespace, self.command) as process,
            LivePlayer(process, kind, options.domain, namespace, odometry) as player,
        ):
            print(f"waiting for the node (model {options.model}) ...", file=sys.stderr)
            player.prime(self.first)
            found = {}
            for name, stabilize in runs.items():
                player.reset(stabilize)
                found[name] = self._run(name, player, odometry is not None, scored)
            return found

    def _run(
        self, name: str, player: LivePlayer, metric: bool, scored: frozenset[int] | None
    ) -> DemoRun:
        limit = self.options.max_frames
        expected = min(self.recording.expected_frames, limit or self.recording.expected_frames)
        evaluation = SequenceEvaluation(expected)
        shown = sorted(evaluation.strip.wanted)[1::2]
        clouds: list[np.ndarray] = []
        answered = set()
        results = player.play(islice(self.recording.frames(), limit))
        for index, result in enumerate(
            tqdm(results, total=expected, desc=name, unit="frame", file=sys.stderr)
        ):
            _check_cloud(result.frame, result.depth, result.cloud)
            if index in shown:
                clouds.append(draw_cloud(*cloud_arrays(result.cloud), CLOUD_SIZE))
            valid = np.isfinite(result.depth)
            if valid.any():
                answered.add(index)
            counts = valid.any() if scored is None else index in scored
            evaluation.push(
                result.frame.image,
                result.depth,
                valid,
                result.frame.depth if counts else None,
                stamp=result.frame.stamp_ns / 1e9,
                latency=result.latency,
                metric=metric and bool(valid.any()),
            )
        pictures = np.hstack(clouds) if clouds else np.zeros((1, 1, 3), np.uint8)
        return DemoRun(evaluation, pictures, frozenset(answered))


def cloud_arrays(cloud: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H x W of messages.CLOUD_DTYPE -> points H x W x 3 float32, colours H x W x 3 uint8 RGB."""
    packed = np.ascontiguousarray(cloud["rgb"]).view(np.uint32)
    colours = np.stack([packed >> 16, packed >> 8, packed], axis=-1).astype(np.uint8)
    return np.stack([cloud[axis] for axis in "xyz"], axis=-1), colours


def _check_cloud(frame: RecordedFrame, depth: np.ndarray, cloud: np.ndarray) -> None:
    """The cloud must be the depth, point for pixel."""
    if not np.array_equal(cloud["z"], depth, equal_nan=True):
        raise LiveError(f"frame {frame.index}: the cloud's z is not the depth image")


def _write(
    options: DemoOptions, recording: Recording, runs: dict[str, DemoRun], notes: list[str]
) -> None:
    evaluations = {name: run.evaluation for name, run in runs.items()}
    results = {name: evaluations[name].results() for name in FILES if name in runs}
    out = options.out
    notes = [*notes, *_withheld(runs), *recording.notes.losses, *recording.notes.warnings]
    hashes = [results[name]["output_sha256"] for name in (BASE, DYFN)]
    if len(set(hashes)) == 1:
        notes.append(f"{options.model} has no DyFN in it: both runs are the base model's")
    clouds = {name: run.clouds for name, run in runs.items()}
    sections = sequence_sections(evaluations, clouds, LATENCY_NOTE, base=BASE)
    if all(result["image"] is not None for result in results.values()):
        (out / "curves.png").write_bytes(encode_picture(curve_picture(evaluations)))
    for name, run in runs.items():
        strip = encode_picture(run.evaluation.draw_strip())
        (out / f"strip_{FILES[name]}.png").write_bytes(strip)
        (out / f"clouds_{FILES[name]}.png").write_bytes(encode_picture(run.clouds))
    if notes:
        sections.append(Section("Notes", [Text(note) for note in notes]))
    write_report(out / "report.html", f"{options.model}, live over DDS", sections)
    summary: dict[str, Any] = {"model": options.model, "runs": results}
    (out / "metrics.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(headline(variants_of(evaluations, BASE)))
    print(text_table(score_table(results)))
    for note in notes:
        print(f"note: {note}")
    frames = evaluations[BASE].frames
    print(f"{frames} frames of {options.recording}, none lost; clouds equal to the depth images")
    print(f"report with pictures: {out / 'report.html'}")


def _withheld(runs: dict[str, DemoRun]) -> list[str]:
    """Which frames are not scored because metres were not known."""
    if MOVING not in runs:
        return []
    evaluation, answered = runs[MOVING].evaluation, runs[MOVING].answered
    missing = evaluation.frames - len(answered)
    if not answered:
        return [f"{MOVING} found no metres in {evaluation.frames} frames and is not scored"]
    stamps = evaluation.column("stamp")
    start = stamps[min(answered)] - stamps[0]
    return [
        f"{MOVING} is in metres from {start:.1f} s on; {missing} of {evaluation.frames} frames "
        "without them are scored in no run"
    ]


LATENCY_NOTE = " Latency: from publishing the image to receiving its depth, over DDS."
