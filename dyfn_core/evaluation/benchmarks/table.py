"""The tables of a benchmark: ours, the controls and what others published, in one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from dyfn_core.evaluation.benchmarks.published import (
    METHODS,
    PARTS,
    Published,
    published_metres,
    published_rows,
)
from dyfn_core.evaluation.report.html import Cell, Table
from dyfn_core.evaluation.report.tables import write_tables

SCORES = tuple((p, m) for p in ("image", "video", "metric") for m in ("abs_rel", "delta1"))
HEADER = (
    "method",
    *(f"{protocol} {'AbsRel' if metric == 'abs_rel' else 'delta1'}" for protocol, metric in SCORES),
    "video RMSE",
    "video log10",
    "scale spread",
    "scale step",
    "TAE",
    "flicker",
    "coverage",
    "origin",
)
ALL_METRICS = (
    *("abs_rel", "delta1", "delta2", "delta3", "rmse", "log10", "sq_rel", "rmse_log"),
    *("i_rmse", "mae", "i_mae"),
)
METRES = {"mae": 1000, "rmse": 1000, "i_mae": 1000, "i_rmse": 1000, "abs_rel": 1}  # factors
METRES_HEADER = (
    *("method", "MAE mm", "RMSE mm", "iMAE 1/km", "iRMSE 1/km", "AbsRel"),
    *("scored frames", "origin"),
)


def result_table(results: dict[str, Any], ablations: bool = False) -> Table:
    """A row per variant and control, the truth's own TAE and flicker, and the published rows.

    results: of evaluate(). ablations: the paper's ablations too. origin: "measured", "control",
    "truth" or "published" (with what the paper says of it).
    """
    rows = [_ours(name, found) for name, found in results["variants"].items()]
    steady = results["temporal_truth"]
    if steady:
        blank: list[Cell] = [None] * (len(HEADER) - 5)
        rows.append(["ground truth", *blank, steady["tae"], steady["flicker"], None, "truth"])
    for part in PARTS if ablations else (METHODS,):
        for method, numbers in published_rows(results["benchmark"], part).items():
            rows.append(_published(method, numbers))
    return Table(HEADER, rows)


def _ours(name: str, found: dict[str, Any]) -> list[Cell]:
    spread, steady = found["spread"] or {}, found["temporal"] or {}
    video = found["video"] or {}
    return [
        name,
        *((found[protocol] or {}).get(metric) for protocol, metric in SCORES),
        video.get("rmse"),
        video.get("log10"),
        spread.get("log_scale_std"),
        spread.get("log_scale_max_step"),
        steady.get("tae"),
        steady.get("flicker"),
        found["coverage"],
        "control" if name.startswith("control: ") else "measured",
    ]


def _published(method: str, numbers: dict[str, Published]) -> list[Cell]:
    scores: list[Cell] = [
        getattr(numbers[protocol], metric) if protocol in numbers else None
        for protocol, metric in SCORES
    ]
    notes = "; ".join(
        f"{protocol}: {number.note}" for protocol, number in numbers.items() if number.note
    )
    rest: list[Cell] = [None] * (len(HEADER) - len(scores) - 2)
    return [method, *scores, *rest, f"published ({notes})" if notes else "published"]


def metres_table(results: dict[str, Any]) -> Table:
    """Errors without alignment of what is in metres, means over all scored frames, and published
    ones; no rows where there are none.

    results: of evaluate().
    """
    rows: list[list[Cell]] = []
    for name in results["in_metres"]:
        scored = [
            (found["scored_frames"], found["metric"])
            for found in (sequence["variants"][name] for sequence in results["sequences"])
            if found["metric"] is not None
        ]
        frames = sum(count for count, _ in scored)
        means: list[Cell] = [
            factor * sum(count * metrics[key] for count, metrics in scored) / frames
            if frames
            else None
            for key, factor in METRES.items()
        ]
        rows.append([name, *means, frames, "measured"])
    for row in published_metres(results["benchmark"]):
        rows.append([row.method, *(getattr(row, key) for key in METRES), None, "published"])
    return Table(METRES_HEADER, rows)


def sequence_table(results: dict[str, Any]) -> Table:
    """A row per sequence, protocol and variant with every metric."""
    header = ("sequence", "method", "protocol", "frames", *ALL_METRICS, "scale", "shift")
    rows: list[list[Cell]] = []
    for sequence in results["sequences"]:
        for name, found in sequence["variants"].items():
            for protocol in ("image", "video", "metric"):
                metrics = found[protocol] or {}
                fit = (found["alignment"] or {}) if protocol == "video" else {}
                rows.append(
                    [
                        sequence["name"],
                        name,
                        protocol,
                        found["scored_frames"],
                        *(metrics.get(metric) for metric in ALL_METRICS),
                        fit.get("scale"),
                        fit.get("shift"),
                    ]
                )
    return Table(header, rows)


def write_results(results: dict[str, Any], folder: Path, title: str, ablations: bool) -> Table:
    """results.json, table.{md,csv,tex}, sequences.{md,csv,tex} and, with rows, metres.{md,csv,tex};
    returns the first table."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "results.json", results)
    table = result_table(results, ablations)
    write_tables(folder, "table", table, title)
    write_tables(folder, "sequences", sequence_table(results), f"{title}, by sequence")
    if (metres := metres_table(results)).rows:
        write_tables(folder, "metres", metres, f"{title}, without alignment")
    return table


def write_json(path: Path, results: dict[str, Any]) -> None:
    """Deterministic JSON. Raises ValueError for a number that JSON has no word for."""
    text = json.dumps(results, indent=1, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8", newline="\n")
