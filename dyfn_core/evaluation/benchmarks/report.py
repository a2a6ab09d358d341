"""The report of a benchmark: tables, pictures, every sequence over time, worst frames, latency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.evaluation.benchmarks.pictures import STRIPS, BenchmarkPictures, WorstFrame
from dyfn_core.evaluation.benchmarks.table import sequence_table
from dyfn_core.evaluation.report.html import (
    Cell,
    Part,
    ReportPicture,
    Section,
    Table,
    Text,
    write_report,
)
from dyfn_core.evaluation.report.sequence import latency_section, over_time_curves

NOTE = (
    "Image: each frame aligned to the truth by its own scale and shift; video: one scale and shift "
    "for the sequence; metric: none. Controls: a vertical ramp and a constant; of a model also its "
    "latent's statistics as a moving average (ema) and those of the first frame (frozen)."
)
PICTURE_NOTE = (
    "Pictures are of the first method in the table, aligned by its sequence's one scale and shift "
    f"(video), evenly spaced frames; of more than {STRIPS} sequences, {STRIPS} evenly spaced ones."
)
WORST_NOTE = (
    "By AbsRel under the video protocol over all sequences, one of each 24th of a sequence. "
    "Pictures are chosen before the alignment is known: where the worst frame itself was not "
    "kept, its neighbour is shown. frame: counted over the scored ones, as in the pictures; "
    "number: the data set's."
)


def write_benchmark_report(
    path: Path,
    title: str,
    table: Table,
    results: dict[str, Any],
    pictures: BenchmarkPictures,
    seconds: Mapping[str, Sequence[float]],
) -> None:
    """table: of result_table; results: of evaluate(), with `options` if there are any.

    pictures: those that evaluate() took. seconds: of every frame by variant, see Method.
    """
    sections = [Section("Scores", [table, Text(NOTE, note=True), Text(PICTURE_NOTE, note=True)])]
    if results["missing"]:
        rows = [[name] for name in results["missing"]]
        sections.append(Section("Not scored", [Table(("sequence",), rows)]))
    for found in results["sequences"]:
        name = found["name"]
        parts = _curves(found)
        if name in pictures.strips:
            parts.insert(0, ReportPicture(pictures.strips[name], f"some frames of {name}"))
        sections.append(Section(f"Over time, {name}", parts))
    sections += _worst(pictures.worst)
    times = {name: np.array(values) * 1000 for name, values in seconds.items() if len(values)}
    sections += [latency_section(times)] if times else []
    sections.append(Section("By sequence", [sequence_table(results)]))
    facts = {**results.get("options", {}), **results["settings"], **results["versions"]}
    facts_table = Table(("", ""), [[name, str(value)] for name, value in facts.items()])
    sections.append(Section("What was run", [facts_table]))
    write_report(path, title, sections)


def _worst(worst: Sequence[WorstFrame]) -> list[Section]:
    if not worst:
        return []
    rows: list[list[Cell]] = [
        [
            found.sequence,
            found.frame,
            found.number,
            found.abs_rel,
            "not kept" if found.shown is None else f"frame {found.shown}",
        ]
        for found in worst
    ]
    header = ("worst first", "frame", "number", "AbsRel", "picture")
    parts: list[Part] = [Table(header, rows)]
    shown = [found.picture for found in worst if found.picture is not None]
    if shown:
        parts.append(ReportPicture(np.vstack(shown), "worst frames, worst first"))
    return [Section("Worst frames", [*parts, Text(WORST_NOTE, note=True)])]


def _curves(sequence: dict[str, Any]) -> list[Part]:
    def lines(column: str) -> dict[str, np.ndarray]:
        found = sequence["over_time"].items()
        return {name: np.array(columns[column], np.float64) for name, columns in found}

    return over_time_curves(lines("scale"), lines("shift"), lines("video_abs_rel"))
