"""Error against the length of a sequence, the alignment solved anew at every length (section 5)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.predictions import Method
from dyfn_core.evaluation.benchmarks.registry import BenchmarkSequence, Opened
from dyfn_core.evaluation.benchmarks.report import data_sections, facts_section, role, shown_table
from dyfn_core.evaluation.benchmarks.run import (
    Note,
    Scoring,
    mean_of,
    observed,
    plain_settings,
    variant_scorers,
    versions,
)
from dyfn_core.evaluation.choices import LENGTHS
from dyfn_core.evaluation.report.curves import Curves
from dyfn_core.evaluation.report.html import Cell, Part, Section, Table, Text, write_report
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.evaluation.report.tables import write_tables
from dyfn_core.evaluation.report.variants import Variant, headline, key_figures
from dyfn_core.scoring.plausibility import Plausibility
from dyfn_core.scoring.protocols import SequenceScorer, drift

Point = dict[str, Any]


def length_curve(
    sequence: BenchmarkSequence,
    method: Method,
    lengths: Sequence[int],
    depth_max: float,
    scoring: Scoring,
    plausibility: Plausibility | None = None,
) -> dict[int, dict[str, Point]]:
    """length -> variant -> video and image metrics and drift over the first `length` frames.

    Lengths that the sequence does not reach are left out. Memory is that of Scoring.max_samples
    per variant, whatever the length. plausibility: takes the frames. Raises FrameError or
    DataError, naming file or sequence.
    """
    frames = sequence.frames() if plausibility is None else observed(sequence, plausibility)
    scorers = variant_scorers(method, depth_max, scoring)
    predict = method.open(sequence)
    curve: dict[int, dict[str, Point]] = {}
    for count, frame in enumerate(frames, start=1):
        try:
            scorers.push(predict(count - 1, frame), frame.truth)
        except ValueError as error:
            raise FrameError(f"{sequence.name}, frame {count - 1}: {error}") from error
        if count in lengths:
            curve[count] = {name: _point(scorer) for name, scorer in scorers.scorers.items()}
        if count >= max(lengths):
            break
    return curve


def _point(scorer: SequenceScorer) -> Point:
    video, image = scorer.video(), scorer.image()
    return {
        "video": None if video is None else video.metrics,
        "image": None if image is None else image.metrics,
        "drift": drift(video),
        "alignment": None if video is None else {"scale": video.scale, "shift": video.shift},
    }


def long_sequences(
    opened: Opened,
    method: Method,
    lengths: Sequence[int] = LENGTHS,
    scoring: Scoring | None = None,
    *,
    allow_missing: bool = False,
    note: Note = lambda line: None,
) -> dict[str, Any]:
    """The curves of all sequences and their means, as plain values.

    lengths: in frames, any positive ones. Every length is a mean over the sequences that reach it,
    whose number stands beside it. Raises ValueError for bad lengths, DataError when no sequence
    reaches the shortest.
    """
    if not lengths or min(lengths) < 1:
        raise ValueError(f"lengths must be positive numbers of frames, got {list(lengths)}")
    scoring, wanted = scoring or Scoring(), sorted(set(lengths))
    missing, curves, warnings = list(opened.missing), {}, []
    for sequence in opened.sequences:
        doubted = Plausibility(min(len(sequence), wanted[-1]))
        limit = opened.settings.depth_max
        try:
            curve = length_curve(sequence, method, wanted, limit, scoring, doubted)
        except (FrameError, DataError) as error:
            if not allow_missing:
                raise
            missing.append(f"{sequence.name}: {error}")
            continue
        curves[sequence.name] = curve
        note(f"{sequence.name}: {len(sequence)} frames, {len(curve)} of {len(wanted)} lengths")
        for text in doubted.warnings(None):
            warnings.append(f"{sequence.name}: {text}")
            note(f"{sequence.name}: implausible: {text}")
    reached = {n: [c[n] for c in curves.values() if n in c] for n in wanted}
    if not reached[wanted[0]]:
        raise DataError(f"no sequence has {wanted[0]} frames that could be scored")
    return {
        "benchmark": opened.benchmark.name,
        "settings": plain_settings(opened),
        "scoring": {"fit": scoring.fit, "max_samples": scoring.max_samples},
        "versions": versions(),
        "missing": missing,
        "problems": opened.report.problems,
        "warnings": warnings,
        "lengths": {
            str(n): {"sequences": len(points), "variants": mean_of(points)}
            for n, points in reached.items()
            if points
        },
        "sequences": {
            name: {str(n): point for n, point in curve.items()} for name, curve in curves.items()
        },
    }


def length_table(results: dict[str, Any]) -> Table:
    """A row per length and variant: video and image AbsRel and delta1."""
    rows: list[list[Cell]] = []
    for length, found in results["lengths"].items():
        for name, point in found["variants"].items():
            scores: list[Cell] = [
                None if point[protocol] is None else point[protocol][metric]
                for protocol in ("video", "image")
                for metric in ("abs_rel", "delta1")
            ]
            rows.append([name, int(length), found["sequences"], *scores])
    header = ("method", "frames", "sequences", "video AbsRel", "video delta1")
    return Table((*header, "image AbsRel", "image delta1"), rows)


def draw_lengths(results: dict[str, Any], title: str) -> np.ndarray:
    """Video AbsRel and delta1 against the number of frames, a line per variant.

    Controls are thin and dashed. Returns H x W x 3 uint8 RGB.
    """
    rows = length_table(results).rows
    figure = Figure(figsize=(9.6, 3.8), dpi=100, layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, column, label in ((axes[0], 3, "AbsRel"), (axes[1], 4, "delta < 1.25")):
        for name in dict.fromkeys(row[0] for row in rows):
            mine = [row for row in rows if row[0] == name]
            control = str(name).startswith("control")
            axis.plot(
                [row[1] for row in mine],
                [np.nan if row[column] is None else row[column] for row in mine],
                "o--" if control else "o-",
                label=name,
                linewidth=1.0 if control else 2.0,
                markersize=3,
            )
        axis.set_xlabel("frames that share one alignment")
        axis.set_title(f"{label}, video protocol", fontsize=10, loc="left")
        axis.grid(alpha=0.3)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=11)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    result: np.ndarray = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return result


def write_lengths(results: dict[str, Any], folder: Path, title: str) -> None:
    """lengths.csv, .md, .tex, lengths.png and report.html in the folder."""
    table = length_table(results)
    write_tables(folder, "lengths", table, title)
    (folder / "lengths.png").write_bytes(encode_picture(draw_lengths(results, title)))
    write_report(
        folder / "report.html", f"{title}: error against length", _sections(results, table)
    )


def _sections(results: dict[str, Any], table: Table) -> list[Section]:
    """What the report of a run has, with the lengths in place of frames."""
    length, longest = list(results["lengths"].items())[-1]
    names = longest["variants"]
    variants = [
        Variant(n, role(n), {**scores, "frames": int(length)}) for n, scores in names.items()
    ]
    lead = Text(f"Under one alignment for all frames: {headline(variants)}", lead=True)
    return [
        Section("At a glance", [lead, key_figures(variants)]),
        *data_sections(results),
        Section("Error against length", [*_curves(results), shown_table(table)]),
        facts_section(results),
    ]


def _curves(results: dict[str, Any]) -> list[Part]:
    found = results["lengths"]
    lengths = [int(length) for length in found]
    names = list(dict.fromkeys(name for point in found.values() for name in point["variants"]))
    muted = {name for name in names if role(name) == "control"}

    def curve(metric: str, label: str, unit: str) -> Part:
        lines = {
            name: [_score(point["variants"].get(name), metric) for point in found.values()]
            for name in names
        }
        title = f"{label}, one alignment for all frames (video)"
        return Curves(title, lines, "frames that share one alignment", unit, lengths, muted)

    return [
        curve("abs_rel", "AbsRel", "share of the true depth"),
        curve("delta1", "delta1", "share"),
    ]


def _score(point: Point | None, metric: str) -> float | None:
    video = None if point is None else point["video"]
    return None if video is None else float(video[metric])
