"""report.Table as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from dyfn_core.evaluation.report.html import Cell, Table, format_cell

_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "–": "--",
    }
)


def markdown_table(table: Table) -> str:
    """First column left, the others right; cells as format_cell shows them."""
    lines = [table.header, ["---", *["---:"] * (len(table.header) - 1)]]
    lines += [[format_cell(cell).replace("|", r"\|") for cell in row] for row in table.rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def csv_table(table: Table) -> str:
    """Floats in full precision, None as an empty cell, lines ended by a bare newline."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.header)
    writer.writerows(["" if cell is None else _exact(cell) for cell in row] for row in table.rows)
    return text.getvalue()


def _exact(cell: Cell) -> str:
    return repr(float(cell)) if isinstance(cell, float) else str(cell)


def latex_table(table: Table, caption: str = "") -> str:
    """A `table` with a `tabular` of plain rules (no package needed), texts escaped."""
    columns = "l" + "r" * (len(table.header) - 1)
    lines = [r"\begin{table}", r"\centering", rf"\begin{{tabular}}{{{columns}}}", r"\hline"]
    lines += [_latex_row(list(table.header)), r"\hline"]
    lines += [_latex_row([format_cell(cell) for cell in row]) for row in table.rows]
    lines += [r"\hline", r"\end{tabular}"]
    if caption:
        lines.append(rf"\caption{{{caption.translate(_LATEX)}}}")
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def _latex_row(cells: list[str]) -> str:
    return " & ".join(cell.translate(_LATEX) for cell in cells) + r" \\"


def write_tables(folder: Path, stem: str, table: Table, caption: str = "") -> list[Path]:
    """stem.md, stem.csv and stem.tex in the folder; returns their paths."""
    texts = {
        ".md": markdown_table(table),
        ".csv": csv_table(table),
        ".tex": latex_table(table, caption),
    }
    paths = []
    for suffix, text in texts.items():
        path = folder / f"{stem}{suffix}"
        path.write_text(text, encoding="utf-8", newline="\n")
        paths.append(path)
    return paths
