"""The report of a benchmark: its tables, and every sequence over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.evaluation.benchmark_table import sequence_table
from dyfn_core.evaluation.report import Curves, Part, Section, Table, Text, write_report
from dyfn_core.evaluation.sequence import over_median

NOTE = (
    "Image: each frame aligned to the truth by its own scale and shift; video: one scale and shift "
    "for the sequence; metric: none. Controls: a vertical ramp and a constant; of a model also its "
    "latent's statistics as a moving average (ema) and those of the first frame (frozen)."
)


def write_benchmark_report(path: Path, title: str, table: Table, results: dict[str, Any]) -> None:
    """table: of result_table; results: of evaluate(), with `options` if there are any."""
    sections = [Section("Scores", [table, Text(NOTE, note=True)])]
    if results["missing"]:
        rows = [[name] for name in results["missing"]]
        sections.append(Section("Not scored", [Table(("sequence",), rows)]))
    sections += [Section(f"Over time, {s['name']}", _curves(s)) for s in results["sequences"]]
    sections.append(Section("By sequence", [sequence_table(results)]))
    facts = {**results.get("options", {}), **results["settings"], **results["versions"]}
    facts_table = Table(("", ""), [[name, str(value)] for name, value in facts.items()])
    sections.append(Section("What was run", [facts_table]))
    write_report(path, title, sections)


def _curves(sequence: dict[str, Any]) -> list[Part]:
    lines = {
        name: {column: np.array(values, np.float64) for column, values in found.items()}
        for name, found in sequence["over_time"].items()
    }
    scale = {name: over_median(found["scale"]) for name, found in lines.items()}
    return [
        Curves("Scale that fits each frame, over its median (flat is stable)", scale),
        Curves("Shift that fits each frame, m", {n: found["shift"] for n, found in lines.items()}),
        Curves(
            "AbsRel, one alignment for the sequence (video)",
            {n: found["video_abs_rel"] for n, found in lines.items()},
        ),
    ]
