"""The paper's published numbers (section 5), as data to stand beside ours."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

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
    data = (
        files("dyfn_core.evaluation.benchmarks")
        .joinpath("published.json")
        .read_text(encoding="utf-8")
    )
    return tuple(Published(**row) for row in json.loads(data)["rows"])


def published_rows(benchmark: str, part: str = METHODS) -> dict[str, dict[str, Published]]:
    """method -> protocol -> number, of one benchmark; nothing for a set the paper has none of."""
    found: dict[str, dict[str, Published]] = {}
    for row in published():
        if row.benchmark == benchmark and row.part == part:
            found.setdefault(row.method, {})[row.protocol] = row
    return found
