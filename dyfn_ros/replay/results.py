"""The results of a replay: metrics.json, frames.csv, strip.png and report.html."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dyfn_core.evaluation.report.cloud_view import CloudView
from dyfn_core.evaluation.report.html import Cell, Section, Table, write_report
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.evaluation.report.sequence import sequence_sections
from dyfn_core.evaluation.sequence import SequenceEvaluation
from dyfn_core.files import finished_file, write_text
from dyfn_core.scoring.protocols import CONTROLS
from dyfn_ros.recordings.frames import Recording
from dyfn_ros.replay.settings import Outputs, Source

CONTROLS_NOTE = (
    " The others put a moving average of the latent's statistics (ema), or those of the first "
    "frame (frozen), in DyFN's place."
)


@dataclass(frozen=True)
class Result:
    """A replay that has ended.

    Attributes:
        name: Of the model, or the topic of the predictions.
        stabilized: Whether DyFN took part.
        evaluation: Of every frame.
        base: Of the same frames without DyFN and odometry; None: not run.
        alone: Of the same frames with DyFN, without the odometry; None: not run, or there is none.
        options: What the run adds to the `options` of metrics.json.
        cloud: Clouds for the report; None: no cloud.
        stream: What metrics.json has of the stream session.
        doubts: What makes the scores implausible, see scoring.plausibility.
    """

    name: str
    stabilized: bool
    evaluation: SequenceEvaluation
    base: SequenceEvaluation | None
    alone: SequenceEvaluation | None
    options: dict[str, Any]
    cloud: CloudView | None
    stream: dict[str, Any] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)


def write_results(
    source: Source, recording: Recording, outputs: Outputs, result: Result
) -> dict[str, Any]:
    """Write scores, table, strip and report.

    Args:
        source: What was read.
        recording: The same, opened and read to its end.
        outputs: Where results go.
        result: What was found.

    Returns:
        The content of metrics.json.

    Raises:
        OutputError: A file cannot be written.
    """
    folder, metrics = outputs.folder, _metrics(source, recording, outputs, result)
    with finished_file(folder / "strip.png") as partial:
        partial.write_bytes(encode_picture(result.evaluation.draw_strip()))
    with finished_file(folder / "frames.csv") as partial:
        _write_rows(partial, result.evaluation)
    _write_report(folder / "report.html", metrics, result)
    text = json.dumps(metrics, indent=2, allow_nan=False) + "\n"
    write_text(folder / "metrics.json", text)
    return metrics


def _metrics(
    source: Source, recording: Recording, outputs: Outputs, result: Result
) -> dict[str, Any]:
    results = result.evaluation.results()
    return {
        "frames": results.pop("frames"),
        "model": result.name,
        "stabilizer": result.stabilized,
        "quantity": result.evaluation.quantity,
        **results,
        **({} if result.base is None else {"base": result.base.results()}),
        **({} if result.alone is None else {"without_odometry": result.alone.results()}),
        **result.stream,
        "warnings": result.doubts,
        "recording": {
            "path": str(source.recording),
            "topics": recording.topics.names,
            "losses": dict(recording.notes.losses),
            "warnings": dict(recording.notes.warnings),
        },
        "options": {
            "stride": source.stride,
            "max_frames": source.max_frames,
            "stamps": source.stamps,
            "tolerance": source.tolerance,
            "depth_transform": source.depth_transform,
            "depth_scale": source.depth_scale,
            "depth_offset": source.depth_offset or None,
            "odometry_offset": source.odometry_offset or None,
            "pose_offset": outputs.pose_offset or None,
            "depth_max": None if math.isinf(outputs.depth_max) else outputs.depth_max,
            **result.options,
        },
    }


def _write_rows(path: Path, evaluation: SequenceEvaluation) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, evaluation.columns)
        writer.writeheader()
        writer.writerows(evaluation.rows())


def _write_report(path: Path, metrics: dict[str, Any], result: Result) -> None:
    recording, blind = metrics["recording"], metrics.get("pictures_without_depth", {})
    facts: list[list[str | float | int | None]] = [
        ["recording", recording["path"]],
        ["frames", metrics["frames"]],
        ["model", metrics["model"]],
        ["DyFN", "on" if metrics["stabilizer"] else "off"],
        ["valid share of the pixels with truth", metrics["coverage"]],
        ["output SHA-256", metrics["output_sha256"][:16]],
        *([topic, value] for topic, value in recording["topics"].items()),
        *([f"resets, {reason}", count] for reason, count in metrics.get("resets", {}).items()),
        *([f"pictures without depth, {why}", count] for why, count in blind.items()),
        *(["reset", line] for line in metrics.get("reset_log", [])),
        *([f"metric scale, {k}", v] for k, v in metrics.get("metric_scale", {}).items()),
        *([f"state {what}", text] for what, text in metrics.get("state", {}).items()),
        *([name, value] for name, value in metrics["options"].items() if value is not None),
    ]
    notes = recording["losses"] | recording["warnings"]
    name = run_name(metrics)
    runs, base = {name: result.evaluation}, None
    if result.alone is not None:
        runs[run_name(metrics, odometry=False)] = result.alone
    if result.base is not None:
        base = run_name({**metrics, "stabilizer": False}, odometry=False)
        runs[base] = result.base
    controlled = result.evaluation.controls.keys() > CONTROLS.keys()
    note = CONTROLS_NOTE if controlled else ""
    sections = sequence_sections(runs, note=note, base=base, cloud=result.cloud)
    if notes:
        rows = [[text, count] for text, count in notes.items()]
        sections.insert(1, Section("Losses and warnings", [Table(("", "times"), rows)]))
    if metrics["warnings"]:
        doubts: list[list[Cell]] = [[text] for text in metrics["warnings"]]
        sections.insert(1, Section("Implausible", [Table(("",), doubts)]))
    sections.append(Section("What was run", [Table(("", ""), facts)]))
    write_report(path, f"Replay of {Path(recording['path']).name}", sections)


def run_name(metrics: dict[str, Any], odometry: bool = True) -> str:
    """How a run is called in tables. odometry: whether it took part, if the run had any."""
    if metrics["model"].startswith("/"):  # a topic: who made it is not known
        return str(metrics["model"])
    moved = odometry and metrics["options"].get("metric_source") == "odometry"
    if not metrics["stabilizer"]:
        return f"{metrics['model']}, base model{' with odometry' if moved else ''}"
    return f"{metrics['model']} with DyFN{' and odometry' if moved else ''}"


def results_by_name(metrics: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What was run -> its results."""
    found = {run_name(metrics): metrics}
    if "without_odometry" in metrics:
        found[run_name(metrics, odometry=False)] = metrics["without_odometry"]
    if "base" in metrics:
        name = run_name({**metrics, "stabilizer": False}, odometry=False)
        found[name] = metrics["base"]
    return found
