"""One self-contained HTML file per evaluation: tables and pictures, no script, no network."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from dyfn_core.evaluation.pictures import encode_picture

Cell = str | float | int | None

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
       color: #1c1e21; background: #fff; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
table { border-collapse: collapse; margin: .5rem 0; }
th, td { padding: .25rem .8rem; border-bottom: 1px solid #d8dbe0; text-align: right; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; height: auto; display: block; margin: .5rem 0; }
p.note { color: #5a6068; font-size: .9rem; }
@media (prefers-color-scheme: dark) {
  body { color: #e6e8eb; background: #16181b; } th, td { border-color: #383c42; }
  p.note { color: #a0a6ae; } }
"""


@dataclass(frozen=True)
class Text:
    """A paragraph; note: small and grey."""

    text: str
    note: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of cells; floats are rounded to three decimals, None is a dash."""

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]


@dataclass(frozen=True)
class Picture:
    """image: H x W x 3 uint8 RGB. photographic: stored as JPEG, else as PNG."""

    image: np.ndarray
    alt: str
    photographic: bool = True


Part = Text | Table | Picture


@dataclass(frozen=True)
class Section:
    """A heading and what is under it."""

    title: str
    parts: Sequence[Part]


def write_report(path: str | Path, title: str, sections: Sequence[Section]) -> None:
    """Write the HTML file; it appears only when it is complete."""
    body = "\n".join(_section(section) for section in sections)
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n"
        f"<body><h1>{escape(title)}</h1>\n{body}\n</body></html>\n"
    )
    target = Path(path)
    partial = target.with_name(f"{target.name}.partial")
    partial.write_text(page, encoding="utf-8")
    partial.replace(target)


def _section(section: Section) -> str:
    parts = "\n".join(_part(part) for part in section.parts)
    return f"<h2>{escape(section.title)}</h2>\n{parts}"


def _part(part: Part) -> str:
    if isinstance(part, Text):
        style = ' class="note"' if part.note else ""
        return f"<p{style}>{escape(part.text)}</p>"
    if isinstance(part, Table):
        head = "".join(f"<th>{escape(name)}</th>" for name in part.header)
        rows = "\n".join(
            "<tr>" + "".join(f"<td>{escape(format_cell(cell))}</td>" for cell in row) + "</tr>"
            for row in part.rows
        )
        return f"<table><thead><tr>{head}</tr></thead><tbody>\n{rows}\n</tbody></table>"
    suffix, kind = (".jpg", "jpeg") if part.photographic else (".png", "png")
    data = base64.b64encode(encode_picture(part.image, suffix)).decode("ascii")
    return f'<img alt="{escape(part.alt, quote=True)}" src="data:image/{kind};base64,{data}">'


def format_cell(cell: Cell) -> str:
    """A cell as people read it."""
    if cell is None:
        return "–"
    return f"{cell:.3f}" if isinstance(cell, float) else str(cell)


def text_table(table: Table) -> str:
    """The table for a terminal: first column left, the others right."""
    lines = [list(table.header), *([format_cell(c) for c in row] for row in table.rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(table.header))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
