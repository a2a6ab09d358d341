"""One table over many replayed recordings: Markdown, CSV and JSON, with confidence intervals."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.evaluation.report.html import format_cell
from dyfn_core.files import finished_file, write_text

SCORES = {
    "image_abs_rel": ("image", "abs_rel"),
    "image_delta1": ("image", "delta1"),
    "video_abs_rel": ("video", "abs_rel"),
    "video_delta1": ("video", "delta1"),
}
STATES = {0: "ok", 3: "partial"}
COLUMNS = ("recording", "state", "code", "frames", *SCORES, "path", "reason", "warnings")
CONFIDENCE, RESAMPLES, SEED = 0.95, 9999, 0


@dataclass(frozen=True)
class Row:
    """One recording. code: its exit code. metrics: its metrics.json; empty when it failed."""

    name: str
    path: str
    code: int
    reason: str
    metrics: dict[str, Any]

    def score(self, name: str) -> float | None:
        """One of SCORES; None without truth or results."""
        protocol, metric = SCORES[name]
        return (self.metrics.get(protocol) or {}).get(metric)

    def cells(self) -> dict[str, str | float | int | None]:
        """By COLUMNS."""
        return {
            "recording": self.name,
            "state": STATES.get(self.code, "failed"),
            "code": self.code,
            "frames": self.metrics.get("frames"),
            **{name: self.score(name) for name in SCORES},
            "path": self.path,
            "reason": self.reason,
            "warnings": "; ".join(self.metrics.get("warnings", [])),
        }


@dataclass(frozen=True)
class Mean:
    """The mean over recordings. low, high: its interval; None under two recordings."""

    mean: float
    low: float | None
    high: float | None
    recordings: int


def mean_of(values: Sequence[float]) -> Mean:
    """Percentile bootstrap over recordings, seeded: the same values give the same interval."""
    low = high = None
    if len(values) > 1:
        from scipy.stats import bootstrap  # half a second, which one recording does without

        found = bootstrap(
            (np.array(values, np.float64),),
            np.mean,
            confidence_level=CONFIDENCE,
            n_resamples=RESAMPLES,
            method="percentile",
            rng=np.random.default_rng(SEED),
        ).confidence_interval
        # a mean of equal values may be off by a rounding, and no mean lies outside its values
        low, high = max(float(found.low), min(values)), min(float(found.high), max(values))
    return Mean(float(np.mean(values)), low, high, len(values))


def means(rows: Sequence[Row]) -> dict[str, Mean | None]:
    """Each score's mean over the recordings that have it; None when none has."""
    scored = {name: [v for r in rows if (v := r.score(name)) is not None] for name in SCORES}
    return {name: mean_of(values) if values else None for name, values in scored.items()}


def write_summary(folder: Path, rows: Sequence[Row]) -> str:
    """Write summary.md, summary.csv and summary.json; returns the Markdown.

    Raises OutputError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    averages = means(rows)
    text = _markdown(rows, averages)
    write_text(folder / "summary.md", text + "\n")
    with (
        finished_file(folder / "summary.csv") as partial,
        partial.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(row.cells() for row in rows)
    summary = {
        "recordings": [row.cells() for row in rows],
        "means": {name: mean and vars(mean) for name, mean in averages.items()},
        "interval": {"confidence": CONFIDENCE, "resamples": RESAMPLES, "seed": SEED},
    }
    write_text(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return text


def _markdown(rows: Sequence[Row], averages: dict[str, Mean | None]) -> str:
    header = ("recording", "state", "frames", *(name.replace("_", " ") for name in SCORES))
    lines = [header, ["---", "---", *["---:"] * (len(header) - 2)]]
    for row in rows:
        cells = row.cells()
        lines.append([format_cell(cells[n]) for n in ("recording", "state", "frames", *SCORES)])
    frames = sum(row.metrics.get("frames", 0) for row in rows)
    lines.append(
        [f"mean, {CONFIDENCE:.0%} interval", "", str(frames), *map(_interval, averages.values())]
    )
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    failed = [f"- {row.name}: {row.reason}" for row in rows if row.reason]
    doubted = [f"- {row.name}: {text}" for row in rows for text in row.metrics.get("warnings", [])]
    lists = {"Not whole:": failed, "Implausible:": doubted}
    told = [line for title, found in lists.items() if found for line in ("", title, "", *found)]
    return "\n".join([table, *told])


def _interval(mean: Mean | None) -> str:
    if mean is None:
        return format_cell(None)
    if mean.low is None or mean.high is None:
        return format_cell(mean.mean)
    return f"{mean.mean:.3f} [{mean.low:.3f}, {mean.high:.3f}]"
