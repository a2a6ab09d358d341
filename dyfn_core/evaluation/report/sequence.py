"""The sections of a report on one sequence: scores, curves, pictures, worst frames, latency."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from dyfn_core.evaluation.report.curves import Curves, Histogram
from dyfn_core.evaluation.report.html import (
    Cell,
    KeyFigures,
    Part,
    ReportPicture,
    Section,
    Table,
    Text,
)
from dyfn_core.evaluation.sequence import (
    SequenceEvaluation,
    latency_marks,
    over_median,
    score_table,
)

SCORE_NOTE = (
    "AbsRel: mean |d - p| / d, lower is better. delta1: share within 25%, higher is better. "
    "Image: each frame aligned to the truth by its own scale and shift; video: one scale and "
    "shift for the whole sequence; metric: no alignment, over the frames in metres. Scale spread: "
    "standard deviation of the log of each frame's own scale. Two controls know nothing of the "
    "image: a vertical ramp and a constant."
)
WORST_NOTE = (
    "Worst by AbsRel under the video protocol, one of each stretch of the recording. The pictures "
    "are chosen while it runs, before the alignment is known: where the worst frame itself was "
    "not kept, its neighbour in the same stretch is shown."
)


def sequence_sections(
    runs: Mapping[str, SequenceEvaluation],
    clouds: Mapping[str, np.ndarray] | None = None,
    note: str = "",
) -> list[Section]:
    """What there is to show of one sequence under one or more ways to run it.

    runs: name -> the evaluation of the same frames; the first is the one the report is about.
    clouds: name -> picture of a cloud, H x W x 3 uint8 RGB. note: more about the scores.
    """
    results = {name: run.results() for name, run in runs.items()}
    scores: list[Part] = [score_table(results), Text(SCORE_NOTE + note, note=True)]
    return [
        Section("At a glance", [_key_figures(next(iter(results.values())))]),
        Section("Scores", scores),
        *_over_time(runs),
        *(
            Section(f"Frames, {name}", [ReportPicture(run.draw_strip(), f"some frames, {name}")])
            for name, run in runs.items()
        ),
        *(
            Section(f"Cloud, {name}", [ReportPicture(cloud, f"cloud, {name}")])
            for name, cloud in (clouds or {}).items()
        ),
        *(section for name, run in runs.items() for section in _worst(name, run)),
        latency_section({name: run.column("latency_ms") for name, run in runs.items()}),
    ]


def _key_figures(result: Mapping[str, Any]) -> KeyFigures:
    video, spread = result["video"] or {}, result["spread"] or {}
    latency = result["latency_ms"] or {}
    figures: dict[str, Cell] = {
        "frames": result["frames"],
        "AbsRel, video protocol": video.get("abs_rel"),
        "delta1, video protocol": video.get("delta1"),
        "spread of log scale": spread.get("log_scale_std"),
        "latency p50, ms": None if "p50" not in latency else f"{latency['p50']:.1f}",
        "latency p99, ms": None if "p99" not in latency else f"{latency['p99']:.1f}",
    }
    return KeyFigures({name: value for name, value in figures.items() if value is not None})


def _over_time(runs: Mapping[str, SequenceEvaluation]) -> list[Section]:
    def lines(column: str) -> dict[str, np.ndarray]:
        return {name: run.column(column) for name, run in runs.items()}

    scale = lines("scale")
    if np.isnan(np.concatenate(list(scale.values()))).all():
        return []
    parts = over_time_curves(scale, lines("shift"), lines("video_abs_rel"))
    parts.append(Curves("AbsRel, each frame by itself (image)", lines("image_abs_rel")))
    return [Section("Over time", parts)]


def over_time_curves(
    scale: Mapping[str, np.ndarray],
    shift: Mapping[str, np.ndarray],
    video_abs_rel: Mapping[str, np.ndarray],
) -> list[Part]:
    """What wanders over a sequence, of every frame by name; NaN: a gap."""
    relative = {name: over_median(values) for name, values in scale.items()}
    return [
        Curves("Scale that fits each frame, over its median (flat is stable)", relative),
        Curves("Shift that fits each frame", shift),
        Curves("AbsRel, one alignment for the sequence (video)", video_abs_rel),
    ]


def _worst(name: str, run: SequenceEvaluation) -> list[Section]:
    video = run.video()
    if video is None:
        return []
    errors, stamps = run.column("video_abs_rel"), run.column("stamp")
    table: list[list[Cell]] = []
    shown = []
    for index in run.worst.choose(errors):
        found = run.worst.nearest(index, errors)
        if found is not None:
            shown.append(found)
        picture = "not kept" if found is None else f"frame {found.index}"
        table.append([f"frame {index}", f"{stamps[index]:.3f}", float(errors[index]), picture])
    header = ("worst first", "stamp, s", "AbsRel", "picture")
    parts: list[Part] = [Table(header, table), Text(WORST_NOTE, note=True)]
    if shown:
        parts.insert(
            1, ReportPicture(run.worst.draw(shown, video.scale, video.shift), "worst frames")
        )
    return [Section(f"Worst frames, {name}", parts)]


def latency_section(milliseconds: Mapping[str, np.ndarray]) -> Section:
    """Histogram, percentiles and frames a second. milliseconds: name -> times of all frames."""
    marks = {name: latency_marks(values) or {} for name, values in milliseconds.items()}
    rows: list[list[Cell]] = [
        [name, *(f"{value:.1f}" for value in found.values()), _rate(found.get("p50"))]
        for name, found in marks.items()
    ]
    histogram = Histogram("Time per frame", milliseconds, "ms", marks)
    header = ("", "p50 ms", "p99 ms", "frames a second (p50)")
    return Section("Latency", [histogram, Table(header, rows)])


def _rate(milliseconds: float | None) -> Cell:
    return f"{1000 / milliseconds:.1f}" if milliseconds else None
