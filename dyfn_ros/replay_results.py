"""What a replay says in the end: metrics.json, frames.csv, strip.png and report.html."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dyfn_core.evaluation.pictures import encode_picture
from dyfn_core.evaluation.report import Picture, Section, Table, Text, write_report
from dyfn_core.evaluation.sequence import (
    COLUMNS,
    SequenceEvaluation,
    curve_picture,
    score_table,
)
from dyfn_ros.finished_file import finished_file
from dyfn_ros.recordings import Recording

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel
    from dyfn_ros.replay import Options


def write_results(
    options: Options, recording: Recording, model: GeometryModel, evaluation: SequenceEvaluation
) -> dict[str, Any]:
    """Write scores, table, strip and report into options.out; -> metrics.json's content.

    Raises OutputError.
    """
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
            "depth_max": None if math.isinf(options.depth_max) else options.depth_max,
        },
    }
    strip = evaluation.draw_strip()
    with finished_file(options.out / "strip.png") as partial:
        partial.write_bytes(encode_picture(strip))
    with finished_file(options.out / "frames.csv") as partial:
        _write_rows(partial, evaluation)
    _write_report(options, metrics, evaluation, Picture(strip, "input, truth, depth, error"))
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    with finished_file(options.out / "metrics.json") as partial:
        partial.write_text(text, encoding="utf-8")
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
    with finished_file(options.out / "report.html") as partial:
        write_report(partial, f"Replay of {options.recording.name}", sections)


SCORE_NOTE = (
    "AbsRel: mean |d - p| / d, lower is better. delta1: share within 25%, higher is better. "
    "Image: each frame aligned to the truth by its own scale and shift; video: one scale and "
    "shift for the whole sequence. Scale spread: standard deviation of the log of each frame's "
    "own scale. The controls know nothing of the image: a vertical ramp and a constant."
)


def run_name(metrics: dict[str, Any]) -> str:
    """How a run is called in tables."""
    return f"{metrics['model']}{' with DyFN' if metrics['stabilizer'] else ', base model'}"
