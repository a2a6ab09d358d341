"""The report of a benchmark: tables, pictures, every sequence over time, worst frames, latency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.evaluation.benchmarks.model_method import BASE
from dyfn_core.evaluation.benchmarks.pictures import STRIPS, BenchmarkPictures, WorstFrame
from dyfn_core.evaluation.benchmarks.table import metres_table, sequence_table
from dyfn_core.evaluation.report.html import Cell, Part, Section, Table, Text, write_report
from dyfn_core.evaluation.report.sequence import latency_section
from dyfn_core.evaluation.report.variants import Role, Variant, headline, key_figures, over_time

NOTE = (
    "Image: each frame aligned to the truth by its own scale and shift; video: one scale and shift "
    "for the sequence; metric: none. Controls: a vertical ramp and a constant; of a model also its "
    "latent's statistics as a moving average (ema) and those of the first frame (frozen)."
)
PICTURE_NOTE = (
    "Depth in pictures is aligned by its sequence's one scale and shift (video), so that drift "
    f"shows; evenly spaced frames; of more than {STRIPS} sequences, {STRIPS} evenly spaced ones. "
    "Worst frames are of the first method in the table."
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
    times = {name: np.array(values) * 1000 for name, values in seconds.items() if len(values)}
    variants = _variants(results)
    notes = [Text(NOTE, note=True), Text(PICTURE_NOTE, note=True)]
    sections = [
        Section("At a glance", [Text(headline(variants), lead=True), key_figures(variants)]),
        *data_sections(results),
        Section("Scores", [shown_table(table, metres=not times), *notes]),
    ]
    if (metres := metres_table(results)).rows:
        sections.append(Section("In metres, without alignment", [metres]))
    for found in results["sequences"]:
        name = found["name"]
        parts = over_time(_sequence_variants(found))
        if name in pictures.strips:
            parts.insert(0, pictures.strips[name])
        sections.append(Section(f"Over time, {name}", parts))
    sections += _worst(pictures.worst)
    sections += [latency_section(times)] if times else []
    sections.append(Section("By sequence", [shown_table(sequence_table(results))]))
    write_report(path, title, [*sections, facts_section(results)])


def data_sections(results: dict[str, Any]) -> list[Section]:
    """What is doubted, what of the data could not be used, and what was not scored."""
    found = []
    if results["warnings"]:
        doubts: list[list[Cell]] = [[text] for text in results["warnings"]]
        found.append(Section("Implausible", [Table(("",), doubts)]))
    if results["problems"]:
        rows: list[list[Cell]] = [
            [f"{reason} ({names[0]}{', ...' if names[1:] else ''})", len(names)]
            for reason, names in results["problems"].items()
        ]
        found.append(Section("Not used", [Table(("", "times"), rows)]))
    if results["missing"]:
        missing: list[list[Cell]] = [[name] for name in results["missing"]]
        found.append(Section("Not scored", [Table(("sequence",), missing)]))
    return found


def facts_section(results: dict[str, Any]) -> Section:
    """Options, settings and versions of a run, those that are set."""
    facts = {**results.get("options", {}), **results["settings"], **results["versions"]}
    rows = [[name, str(value)] for name, value in facts.items() if value is not None]
    return Section("What was run", [Table(("", ""), rows)])


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
    parts += [found.picture for found in worst if found.picture is not None]
    return [Section("Worst frames", [*parts, Text(WORST_NOTE, note=True)])]


def role(variant: str) -> Role:
    """What a variant of a method, or a control, is in the report."""
    if variant.startswith("control: "):
        return "control"
    return "base" if variant.endswith(BASE) else "result"


def _variants(results: dict[str, Any]) -> list[Variant]:
    """The means over all sequences. Without DyFN the base is what the report is about."""
    names = results["variants"]
    alone = all(role(name) != "result" for name in names)
    found = []
    for name, scores in names.items():
        shown = {key: scores[key] for key in ("video", "drift")}
        kind = "result" if alone and role(name) == "base" else role(name)
        found.append(Variant(name, kind, {**shown, "frames": results["frames"]}))
    return found


def _sequence_variants(sequence: dict[str, Any]) -> list[Variant]:
    return [
        Variant(name, role(name), {}, {c: np.array(v, np.float64) for c, v in columns.items()})
        for name, columns in sequence["over_time"].items()
    ]


def shown_table(table: Table, metres: bool = True) -> Table:
    """Without columns that are empty; controls grey. metres: False leaves the metric protocol out,
    for depth that no model says to be in metres."""
    header = [*table.header]
    kept = [
        column
        for column, name in enumerate(header)
        if any(row[column] is not None for row in table.rows)
        and (metres or not name.startswith("metric "))
    ]
    rows = [[row[column] for column in kept] for row in table.rows]
    muted = {str(cell) for row in rows for cell in row[:2] if role(str(cell)) == "control"}
    return Table([header[column] for column in kept], rows, muted)
