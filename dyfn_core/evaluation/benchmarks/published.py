"""Published numbers as data to stand beside ours: the paper's (section 5), and others' metres."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

METHODS, ABLATIONS = PARTS = ("methods", "ablations")


@dataclass(frozen=True)
class Published:
    """One cell of the paper's tables.

    part: one of PARTS. benchmark: as in BENCHMARKS. protocol: "video", "image" or "metric" (no
    alignment). delta1: share of pixels, 0..1. note: what the paper says of the number, if anything.
    """

    part: str
    method: str
    benchmark: str
    protocol: str
    abs_rel: float
    delta1: float
    note: str


@cache
def published() -> tuple[Published, ...]:
    """All numbers, in the paper's order."""
    return tuple(Published(**row) for row in _rows("published.json"))


def _rows(name: str) -> list[dict[str, Any]]:
    file = files("dyfn_core.evaluation.benchmarks").joinpath(name)
    rows: list[dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))["rows"]
    return rows


@dataclass(frozen=True)
class PublishedMetres:
    """One method's errors without alignment, by others than the paper.

    mae, rmse: millimetres. i_mae, i_rmse: 1 / km. Where they are from: published_metres.json.
    """

    method: str
    benchmark: str
    mae: float
    rmse: float
    i_mae: float
    i_rmse: float
    abs_rel: float


def published_metres(benchmark: str) -> list[PublishedMetres]:
    """The rows of one benchmark; none for most."""
    rows = (PublishedMetres(**row) for row in _rows("published_metres.json"))
    return [row for row in rows if row.benchmark == benchmark]


def published_rows(benchmark: str, part: str = METHODS) -> dict[str, dict[str, Published]]:
    """method -> protocol -> number, of one benchmark; nothing for a set the paper has none of."""
    found: dict[str, dict[str, Published]] = {}
    for row in published():
        if row.benchmark == benchmark and row.part == part:
            found.setdefault(row.method, {})[row.protocol] = row
    return found
