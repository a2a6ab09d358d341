"""The tables of benchmarks/speed.py in docs/PERFORMANCE.md, between their markers."""

from __future__ import annotations

import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from paired import Measured

BEGIN, END = "<!-- {}: written by `make bench` -->", "<!-- end of {} -->"


def machine() -> dict[str, Any]:
    """What the numbers are of."""
    found = re.search(r"^model name\s*:\s*(.*)$", _read("/proc/cpuinfo"), re.MULTILINE)
    return {
        "processor": found.group(1) if found else platform.processor(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def write_page(
    path: Path,
    facts: Mapping[str, Any],
    tables: Mapping[str, Mapping[str, Measured]],
    intros: Mapping[str, str],
) -> None:
    """Put the tables between their markers; what the page says around them stays.

    Args:
        path: The page.
        facts: As `machine` gives them, and of the run.
        tables: Of one run.
        intros: A sentence for each.

    Raises:
        ValueError: The page has no markers for a table.
    """
    text = path.read_text(encoding="utf-8")
    named = ", ".join(f"{key} {value}" for key, value in facts.items())
    text = _between(text, "machine", f"{named[0].upper()}{named[1:]}.")
    for title, rows in tables.items():
        text = _between(text, title, f"{intros[title]}\n\n{_table(rows)}")
    path.write_text(text, encoding="utf-8")


def _table(rows: Mapping[str, Measured]) -> str:
    floors = any(row.floor is not None for row in rows.values())
    head = ["", "ms", "ratio", "quartiles", *(["floor, ms", "over floor"] if floors else [])]
    lines = [head, ["---"] * len(head)]
    for name, row in rows.items():
        cells = [name, f"{row.milliseconds:.1f}", _digits(row.ratio)]
        cells.append(f"{_digits(row.low)} to {_digits(row.high)}")
        if floors and row.floor is None:
            cells += ["–", "–"]
        elif row.floor is not None:
            cells += [f"{row.floor:.1f}", f"{row.milliseconds / row.floor:.2f}"]
        lines.append(cells)
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _digits(ratio: float) -> str:
    return f"{ratio:.2f}" if ratio >= 0.2 else f"{ratio:.3f}"


def _between(text: str, title: str, content: str) -> str:
    begin, end = BEGIN.format(title), END.format(title)
    if begin not in text or end not in text:
        raise ValueError(f"the page has no place for {title}: expected {begin!r} and {end!r}")
    before, after = text.index(begin) + len(begin), text.index(end)
    return f"{text[:before]}\n{content}\n{text[after:]}"


def _read(path: str) -> str:
    file = Path(path)
    return file.read_text(encoding="utf-8") if file.exists() else ""
