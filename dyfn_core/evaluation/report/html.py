"""One self-contained HTML file per evaluation: tables, curves and pictures, no network needed."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from dyfn_core.evaluation.report.curves import (
    Curves,
    Histogram,
    curves_html,
    histogram_html,
)
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.evaluation.report.style import SCRIPT, STYLE
from dyfn_core.files import write_text

Cell = str | float | int | None


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
class ReportPicture:
    """image: H x W x 3 uint8 RGB. photographic: stored as JPEG, else as PNG."""

    image: np.ndarray
    alt: str
    photographic: bool = True


@dataclass(frozen=True)
class KeyFigures:
    """A few numbers, large. figures: what it is -> value."""

    figures: Mapping[str, Cell]


Part = Text | Table | ReportPicture | Curves | Histogram | KeyFigures


@dataclass(frozen=True)
class Section:
    """A heading and what is under it."""

    title: str
    parts: Sequence[Part]


def write_report(path: str | Path, title: str, sections: Sequence[Section]) -> None:
    """Write the HTML file; it appears only when it is complete."""
    body = "\n".join(_section(number, section) for number, section in enumerate(sections))
    links = "".join(f'<a href="#s{n}">{escape(s.title)}</a>' for n, s in enumerate(sections))
    interactive = any(isinstance(part, Curves) for s in sections for part in s.parts)
    script = f"<script>{SCRIPT}</script>\n" if interactive else ""
    page = (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n"
        f"<body><h1>{escape(title)}</h1>\n<nav>{links}</nav>\n{body}\n{script}</body></html>\n"
    )
    write_text(Path(path), page)


def _section(number: int, section: Section) -> str:
    parts = "\n".join(_part(part) for part in section.parts)
    return f'<section id="s{number}"><h2>{escape(section.title)}</h2>\n{parts}</section>'


def _part(part: Part) -> str:
    if isinstance(part, Text):
        style = ' class="note"' if part.note else ""
        return f"<p{style}>{escape(part.text)}</p>"
    if isinstance(part, Table):
        return _table(part)
    if isinstance(part, Curves):
        return curves_html(part)
    if isinstance(part, Histogram):
        return histogram_html(part)
    if isinstance(part, KeyFigures):
        figures = "".join(
            f"<div><b>{escape(format_cell(value))}</b><span>{escape(name)}</span></div>"
            for name, value in part.figures.items()
        )
        return f'<div class="figures">{figures}</div>'
    suffix, kind = (".jpg", "jpeg") if part.photographic else (".png", "png")
    data = base64.b64encode(encode_picture(part.image, suffix)).decode("ascii")
    return f'<img alt="{escape(part.alt, quote=True)}" src="data:image/{kind};base64,{data}">'


def _table(part: Table) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in part.header)
    rows = "\n".join(
        "<tr>" + "".join(f"<td>{escape(format_cell(cell))}</td>" for cell in row) + "</tr>"
        for row in part.rows
    )
    head = f"<thead><tr>{head}</tr></thead>" if any(part.header) else ""
    return f'<div class="wide"><table>{head}<tbody>\n{rows}\n</tbody></table></div>'


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
