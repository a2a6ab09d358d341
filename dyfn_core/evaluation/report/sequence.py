"""The sections of a report on one sequence: scores, curves, pictures, worst frames, latency."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from dyfn_core.evaluation.report.cloud_view import CloudView
from dyfn_core.evaluation.report.curves import Histogram
from dyfn_core.evaluation.report.frame_grid import frame_grid
from dyfn_core.evaluation.report.html import Cell, Part, ReportPicture, Section, Table, Text
from dyfn_core.evaluation.report.variants import (
    Variant,
    headline,
    key_figures,
    over_time,
    seconds_axis,
)
from dyfn_core.evaluation.sequence import SequenceEvaluation, latency_marks, score_table
from dyfn_core.scoring.protocols import SequenceScorer

SCORE_NOTE = (
    "AbsRel: mean |d - p| / d, lower is better. delta1: share within 25%, higher is better. "
    "Image: each frame aligned to the truth by its own scale and shift; video: one scale and "
    "shift for the whole sequence; metric: no alignment, over the frames in metres. Drift: "
    "standard deviation of the log of each frame's true over predicted depth, as aligned for "
    "video. Two controls know nothing of the image: a vertical ramp and a constant."
)
WORST_NOTE = (
    "Worst by AbsRel under the video protocol, one of each stretch of the recording. The pictures "
    "are chosen while it runs, before the alignment is known: where the worst frame itself was "
    "not kept, its neighbour in the same stretch is shown."
)


FRAMES_NOTE = (
    "One alignment (scale and shift) to the truth for all frames of a run, so that drift shows."
)
UNALIGNED_NOTE = "Without ground truth a depth has no unit: red is near, blue is far."
COLUMNS = ("video_ratio", "shift", "video_abs_rel", "image_abs_rel", "metric_abs_rel")


def sequence_sections(
    runs: Mapping[str, SequenceEvaluation],
    clouds: Mapping[str, np.ndarray] | None = None,
    note: str = "",
    *,
    base: str | None = None,
    cloud: CloudView | None = None,
) -> list[Section]:
    """What there is to show of one sequence under one or more ways to run it.

        runs = {"DyFN": with_dyfn, "base model": without, "DyFN + odometry": metric}
        sections = sequence_sections(runs, base="base model")
        write_report("report.html", "Title", sections)

    Every run is in the sentence and the key figures on top, in the table, in every curve and in
    the strip of frames, under its name; runs whose depth is in metres (`metric=True` of push) have
    the metric protocol beside the others. Controls of the first run are drawn grey.

    Args:
        runs: Name -> the evaluation of the same frames; the first is what the report is about.
        clouds: Name -> picture of a cloud, H x W x 3 uint8 RGB.
        note: More about the scores.
        base: The run that the others are compared with.
        cloud: Clouds that can be turned.

    Returns:
        Sections for write_report; those that need ground truth are left out without it.

    Raises:
        ValueError: base is no run, or the first one.
    """
    if base is not None and base not in [*runs][1:]:
        raise ValueError(f"base is {base!r}, expected one of the runs after the first: {[*runs]}")
    first = next(iter(runs.values()))
    variants = variants_of(runs, base)
    results = {name: run.results() for name, run in runs.items()}
    curves = over_time(variants, first.column("stamp"))
    pictures = {f"Cloud, {name}": picture for name, picture in (clouds or {}).items()}
    scores: list[Part] = [score_table(results), Text(SCORE_NOTE + note, note=True)]
    return [
        Section("At a glance", [Text(headline(variants), lead=True), key_figures(variants)]),
        *([Section("Frames", _frames(runs, base))] if first.strip.snapshots else []),
        *([Section("Over time", curves)] if curves else []),
        *([Section("Scores", scores)] if first.video() is not None else []),
        *([Section("Cloud", [cloud])] if cloud is not None else []),
        *(Section(name, [ReportPicture(shown, name)]) for name, shown in pictures.items()),
        *(found for name, run in runs.items() if name != base for found in _worst(name, run)),
        latency_section({name: run.column("latency_ms") for name, run in runs.items()}),
    ]


def variants_of(runs: Mapping[str, SequenceEvaluation], base: str | None = None) -> list[Variant]:
    """Evaluations, and the controls of the first, as the report compares them.

    Args:
        runs: Name -> evaluation.
        base: The run that the others are compared with.

    Returns:
        In the order of runs, then the controls ("control: NAME") that could be scored.
    """
    found = []
    for name, run in runs.items():
        columns = {column: run.column(column) for column in COLUMNS}
        scores = {**run.results(), "quantity": run.quantity}
        found.append(Variant(name, "base" if name == base else "result", scores, columns))
    return [*found, *_controls(next(iter(runs.values())).controls)]


def _controls(scorers: Mapping[str, SequenceScorer]) -> Iterator[Variant]:
    for name, scorer in scorers.items():
        video = scorer.video()
        if video is not None:
            columns = {
                "video_ratio": np.array(video.ratios),
                "video_abs_rel": video.frames.column("abs_rel"),
                "image_abs_rel": scorer.frames.metrics.column("abs_rel"),
            }
            yield Variant(f"control: {name}", "control", {"video": video.metrics}, columns)


def _frames(runs: Mapping[str, SequenceEvaluation], base: str | None) -> list[Part]:
    first = next(iter(runs.values()))
    order = sorted(runs, key=lambda name: name != base)  # what the others are compared with, first
    shown = {name: runs[name].shown_frames() for name in order}
    note = UNALIGNED_NOTE if first.video() is None else FRAMES_NOTE
    grid = frame_grid(shown, _frame_label(first.column("stamp")), "some frames")
    return [grid, Text(note, note=True)]


def _frame_label(stamps: np.ndarray) -> Callable[[int], str]:
    """Names a frame by its time from the start, or by its number where stamps fall."""
    seconds, _ = seconds_axis(stamps)
    return lambda index: f"frame {index}" if seconds is None else f"{seconds[index]:.2f} s"


def _worst(name: str, run: SequenceEvaluation) -> list[Section]:
    video = run.video()
    if video is None:
        return []
    errors, label = run.column("video_abs_rel"), _frame_label(run.column("stamp"))
    table: list[list[Cell]] = []
    shown = []
    for index in run.worst.choose(errors):
        found = run.worst.nearest(index, errors)
        if found is not None:
            shown.append(found)
        picture = "not kept" if found is None else f"frame {found.index}"
        table.append([f"frame {index}", label(index), float(errors[index]), picture])
    header = ("worst first", "time", "AbsRel", "picture")
    parts: list[Part] = [Table(header, table), Text(WORST_NOTE, note=True)]
    if shown:
        frames = {name: run.worst.shown(shown, video.scale, video.shift)}
        parts.insert(1, frame_grid(frames, lambda index: f"frame {index}", "worst frames"))
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
