"""`python -m tests.support.faults.table --write`: does every fault, and writes docs/faults.md."""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from tests.support.faults import (
    camera_infos,
    models,
    motion,
    pictures,
    processes,
    references,
    requests,
    state_files,
)
from tests.support.faults.bench import Bench, faulty_bench
from tests.support.faults.fault import Fault, Row, run
from tests.support.ros_graph import own_domain

MANUAL = Path("docs/faults.md")
BEGIN = "<!-- rows: written by `python -m tests.support.faults.table --write` -->"
END = "<!-- end of rows -->"
HEAD = ("| fault | result | what came of it | back to good depth |", "| --- | --- | --- | --- |")


@dataclass(frozen=True)
class Kind:
    """Faults that are done to one node. open: makes it, on a domain."""

    title: str
    faults: Sequence[Fault]
    open: Callable[[dict[str, str]], AbstractContextManager[Bench]] = faulty_bench


KINDS = (
    Kind("Pictures", pictures.FAULTS),
    Kind("Camera infos", camera_infos.FAULTS),
    Kind("Measurements for the metric scale", references.FAULTS, references.reference_bench),
    Kind("Odometry, transforms and clocks", motion.FAULTS, motion.motion_bench),
    Kind("Requests", requests.FAULTS),
    Kind("State files", state_files.FAULTS, state_files.state_bench),
    Kind("Models and devices", models.FAULTS, models.model_bench),
    Kind("Processes", processes.FAULTS, processes.process_bench),
)


def happened(kind: Kind, report: Callable[[str], None]) -> list[Row]:
    """Do the faults one after the other. Raises AssertionError, see `run`."""
    rows = []
    with own_domain() as domain, kind.open(domain) as bench:
        for fault in kind.faults:
            start = time.monotonic()
            rows.append(run(fault, bench))
            report(f"{time.monotonic() - start:6.2f} s  {rows[-1].result}: {fault.name}")
    return rows


def table(kinds: dict[str, list[Row]]) -> str:
    """Markdown: one table per kind."""
    parts = []
    for title, rows in kinds.items():
        parts.append("\n".join([f"## {title}", "", *HEAD, *map(_line, rows)]))
    return "\n\n".join(parts)


def _line(row: Row) -> str:
    said = [f"`{shown(text)}`" for text in row.said]
    came = "; ".join([row.gave, *said])
    pictures = f"{row.frames} picture{'s' * (row.frames > 1)}, {row.seconds:.2f} s"
    cells = (row.name, row.result, came, pictures)
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def shown(text: str) -> str:
    """Without folders of this machine and names of hundreds of characters."""
    text = re.sub(rf"{re.escape(tempfile.gettempdir())}/\w+", "FOLDER", text)
    return re.sub(r"(.)\1{30,}", r"\1\1\1...", text)


def updated(text: str, kinds: dict[str, list[Row]]) -> str:
    """The manual with such rows. Raises ValueError when it has no place for them."""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{MANUAL} lacks {BEGIN!r} or {END!r}")
    return f"{before}{BEGIN}\n\n{table(kinds)}\n\n{END}{after}"


def written(text: str) -> dict[str, dict[str, str]]:
    """What a manual says: for each kind the results by fault."""
    found: dict[str, dict[str, str]] = {}
    _, _, rest = text.partition(BEGIN)
    for line in rest.partition(END)[0].splitlines():
        if line.startswith("## "):
            found[line[3:]] = {}
        elif line.startswith("| ") and line not in HEAD:
            name, result, *_ = (cell.strip() for cell in line.strip("|").split(" | "))
            found[list(found)[-1]][name] = result
    return found


def main() -> int:
    """-> exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"the rows into {MANUAL}")
    options = parser.parse_args()
    rows = {kind.title: happened(kind, print) for kind in KINDS}
    if options.write:
        MANUAL.write_text(updated(MANUAL.read_text("utf-8"), rows), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
