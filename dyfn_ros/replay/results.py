"""What a replay says in the end: metrics.json, frames.csv, strip.png and report.html."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dyfn_core.evaluation.report.html import Section, Table, write_report
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.evaluation.report.sequence import sequence_sections
from dyfn_core.evaluation.sequence import COLUMNS, SequenceEvaluation
from dyfn_core.files import finished_file
from dyfn_ros.recordings.open import Recording

if TYPE_CHECKING:
    from dyfn_ros.replay.options import ReplayOptions


CONTROLS_NOTE = (
    " The others put a moving average of the latent's statistics (ema), or those of the first "
    "frame (frozen), in DyFN's place."
)


@dataclass(frozen=True)
class Result:
    """A replay that has ended.

    name: of the model, or the topic of the predictions. stabilized: with DyFN. base: the same
    frames without DyFN, if they were run. threads: that computed, 0 where no model ran. cloud:
    picture of the fused cloud, H x W x 3 uint8 RGB.
    """

    recording: Recording
    name: str
    stabilized: bool
    evaluation: SequenceEvaluation
    base: SequenceEvaluation | None
    threads: int
    cloud: np.ndarray | None


def write_results(options: ReplayOptions, result: Result) -> dict[str, Any]:
    """Write scores, table, strip and report into options.out; -> metrics.json's content.

    Raises OutputError.
    """
    metrics = _metrics(options, result)
    with finished_file(options.out / "strip.png") as partial:
        partial.write_bytes(encode_picture(result.evaluation.draw_strip()))
    with finished_file(options.out / "frames.csv") as partial:
        _write_rows(partial, result.evaluation)
    with finished_file(options.out / "report.html") as partial:
        _write_report(partial, options, metrics, result)
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    with finished_file(options.out / "metrics.json") as partial:
        partial.write_text(text, encoding="utf-8")
    return metrics


def _metrics(options: ReplayOptions, result: Result) -> dict[str, Any]:
    recording = result.recording
    results = result.evaluation.results()
    return {
        "frames": results.pop("frames"),
        "model": result.name,
        "stabilizer": result.stabilized,
        "quantity": result.evaluation.quantity,
        **results,
        **({} if result.base is None else {"base": result.base.results()}),
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
            "threads": result.threads,
            "depth_max": None if math.isinf(options.depth_max) else options.depth_max,
            **({} if options.prediction_topic is None else {"predicted": options.quantity}),
        },
    }


def _write_rows(path: Path, evaluation: SequenceEvaluation) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(evaluation.rows())


def _write_report(
    path: Path, options: ReplayOptions, metrics: dict[str, Any], result: Result
) -> None:
    facts: list[list[str | float | int | None]] = [
        ["recording", str(options.recording)],
        ["frames", metrics["frames"]],
        ["model", metrics["model"]],
        ["DyFN", "on" if metrics["stabilizer"] else "off"],
        ["valid share of the pixels with truth", metrics["coverage"]],
        ["output SHA-256", metrics["output_sha256"][:16]],
        *([topic, value] for topic, value in metrics["recording"]["topics"].items()),
        *([name, value] for name, value in metrics["options"].items() if value is not None),
    ]
    notes = metrics["recording"]["losses"] | metrics["recording"]["warnings"]
    name = run_name(metrics)
    runs = {name: result.evaluation}
    if result.base is not None:
        runs[run_name({**metrics, "stabilizer": False})] = result.base
    clouds = {} if result.cloud is None else {f"{name}, fused, from above": result.cloud}
    sections = sequence_sections(runs, clouds, CONTROLS_NOTE if options.controls else "")
    if notes:
        rows = [[text, count] for text, count in notes.items()]
        sections.insert(1, Section("Losses and warnings", [Table(("", "times"), rows)]))
    sections.append(Section("What was run", [Table(("", ""), facts)]))
    write_report(path, f"Replay of {options.recording.name}", sections)


def run_name(metrics: dict[str, Any]) -> str:
    """How a run is called in tables."""
    if metrics["model"].startswith("/"):  # a topic: who made it is not known
        return str(metrics["model"])
    return f"{metrics['model']}{' with DyFN' if metrics['stabilizer'] else ', base model'}"


def results_by_name(metrics: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What was run -> its results."""
    found = {run_name(metrics): metrics}
    if "base" in metrics:
        found[run_name({**metrics, "stabilizer": False})] = metrics["base"]
    return found
