"""One self-contained HTML file per evaluation: tables, curves and pictures, no network needed."""

from __future__ import annotations

import base64
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import numpy as np

from dyfn_core.evaluation.report.cloud_view import CLOUD_SCRIPT, CloudView, cloud_html
from dyfn_core.evaluation.report.curves import (
    CLIP,
    Curves,
    Histogram,
    curves_html,
    histogram_html,
)
from dyfn_core.evaluation.report.frame_grid import FrameGrid, grid_html
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.evaluation.report.style import CURVES_SCRIPT, STYLE
from dyfn_core.files import write_text

WIDE = 8  # columns that a table may have before it is set small
Cell = str | float | int | None


@dataclass(frozen=True)
class Text:
    """A paragraph; note: small and grey; lead: large, what the report says in one sentence."""

    text: str
    note: bool = False
    lead: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of cells; floats are rounded to three decimals, None is a dash.

    muted: rows with one of these among their first two cells are grey.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    muted: Collection[str] = ()


@dataclass(frozen=True)
class ReportPicture:
    """image: H x W x 3 uint8 RGB. photographic: stored as JPEG, else as PNG."""

    image: np.ndarray
    alt: str
    photographic: bool = True


@dataclass(frozen=True)
class KeyFigure:
    """A number, large.

    wanted: which way is better. beside: name of another run -> its value. change: against the
    base, in words; better: whether that is an improvement, None when it is neither.
    """

    name: str
    value: str
    wanted: str = ""
    beside: Mapping[str, str] = field(default_factory=dict)
    change: str = ""
    better: bool | None = None


@dataclass(frozen=True)
class KeyFigures:
    """A few numbers side by side."""

    figures: Sequence[KeyFigure]


Part = Text | Table | ReportPicture | Curves | Histogram | KeyFigures | FrameGrid | CloudView


@dataclass(frozen=True)
class Section:
    """A heading and what is under it."""

    title: str
    parts: Sequence[Part]


def write_report(path: str | Path, title: str, sections: Sequence[Section]) -> None:
    """Write the HTML file; it appears only when it is complete."""
    write_text(Path(path), report_html(title, sections))


def report_html(title: str, sections: Sequence[Section]) -> str:
    """The whole page, which needs no other file."""
    body = "\n".join(_section(number, section) for number, section in enumerate(sections))
    links = "".join(f'<a href="#s{n}">{escape(s.title)}</a>' for n, s in enumerate(sections))
    parts = [part for section in sections for part in section.parts]
    clip, scripts = "", []
    if any(isinstance(part, Curves) for part in parts):
        clip, scripts = CLIP, [CURVES_SCRIPT]
    if any(isinstance(part, CloudView) for part in parts):
        scripts.append(CLOUD_SCRIPT)
    script = "".join(f"<script>{text}</script>\n" for text in scripts)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n"
        f"<body>{clip}<h1>{escape(title)}</h1>\n<nav>{links}</nav>\n{body}\n{script}</body></html>\n"
    )


def _section(number: int, section: Section) -> str:
    parts = "\n".join(_part(part) for part in section.parts)
    return f'<section id="s{number}"><h2>{escape(section.title)}</h2>\n{parts}</section>'


def _part(part: Part) -> str:
    if isinstance(part, Text):
        style = "lead" if part.lead else "note" if part.note else "text"
        return f'<p class="{style}">{escape(part.text)}</p>'
    if isinstance(part, Table):
        return _table(part)
    if isinstance(part, Curves):
        return curves_html(part)
    if isinstance(part, Histogram):
        return histogram_html(part)
    if isinstance(part, KeyFigures):
        return f'<div class="figures">{"".join(map(_key_figure, part.figures))}</div>'
    if isinstance(part, FrameGrid):
        return grid_html(part)
    if isinstance(part, CloudView):
        return cloud_html(part)
    suffix, kind = (".jpg", "jpeg") if part.photographic else (".png", "png")
    data = base64.b64encode(encode_picture(part.image, suffix)).decode("ascii")
    return f'<img alt="{escape(part.alt, quote=True)}" src="data:image/{kind};base64,{data}">'


def _key_figure(figure: KeyFigure) -> str:
    note = f" <small>({escape(figure.wanted)})</small>" if figure.wanted else ""
    change = ""
    if figure.change:
        style = {True: "better", False: "worse", None: "same"}[figure.better]
        change = f'<em class="{style}">{escape(figure.change)}</em>'
    beside = "".join(
        f"<small>{escape(name)}: {escape(value)}</small>" for name, value in figure.beside.items()
    )
    return (
        f"<div><span>{escape(figure.name)}{note}</span>"
        f"<b>{escape(figure.value)}</b>{change}{beside}</div>"
    )


def _table(part: Table) -> str:
    style = "facts" if not any(part.header) else "narrow"
    names: Sequence[str] = [""] * len(part.header)
    if len(part.header) > WIDE:  # in a narrow window each cell says its column's name
        style, names = "wide", part.header
    head = "".join(f"<th>{escape(name)}</th>" for name in part.header)
    head = f"<thead><tr>{head}</tr></thead>" if any(part.header) else ""
    rows = "\n".join(_row(names, row, any(c in part.muted for c in row[:2])) for row in part.rows)
    return f'<table class="{style}">{head}<tbody>\n{rows}\n</tbody></table>'


def _row(names: Sequence[str], row: Sequence[Cell], muted: bool) -> str:
    cells = []
    for name, cell in zip(names, row, strict=True):
        said = f' data-name="{escape(name, quote=True)}"' if name else ""
        cells.append(f"<td{said}>{escape(format_cell(cell))}</td>")
    return f"<tr{' class=muted' if muted else ''}>{''.join(cells)}</tr>"


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
