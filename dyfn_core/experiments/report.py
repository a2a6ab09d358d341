"""Tables of experiments, written between markers into a Markdown file."""

from __future__ import annotations

import re
import shlex
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from dyfn_core.evaluation.empirical_study import StatisticsGrid, grid_ranges
from dyfn_core.evaluation.report.html import format_cell
from dyfn_core.evaluation.variants import BASE_ROWS, gap_closed
from dyfn_core.experiments.declared import Experiment
from dyfn_core.experiments.runner import ArmScores
from dyfn_core.files import write_text
from dyfn_core.scoring.variants import VariantScore

HEADING = "## Experiments"
METRICS = ("image_abs_rel", "video_abs_rel", "video_delta1")
TEXT_WIDTH = 100
TITLES = ("image AbsRel", "video AbsRel", "video delta1", "gap closed")


def trained_table(
    controls: Mapping[str, Mapping[str, VariantScore]], arms: Mapping[str, ArmScores]
) -> str:
    """One table for each data set: the controls, then the arms as mean ± deviation over seeds."""
    tables = []
    for data, row in controls.items():
        lines = [f"| {' | '.join([data, *TITLES])} |", f"|{' --- |' * (len(TITLES) + 1)}"]
        for name in BASE_ROWS:
            cells = [name, *(f"{getattr(row[name], metric):.3f}" for metric in METRICS)]
            learned = name in ("ema", "frozen")
            closed = [100 * gap_closed(dict(row), name)]
            cells.append(mean_spread(closed, digits=0, unit="%") if learned else "")
            lines.append(f"| {' | '.join(cells)} |")
        for name, arm in arms.items():
            cells = [f"**{name}**", *_arm_cells(row, arm.scores.get(data, []))]
            lines.append(f"| {' | '.join(cells)} |")
        tables.append("\n".join(lines))
    return "\n\n".join(tables)


def _arm_cells(controls: Mapping[str, VariantScore], scores: Sequence[VariantScore]) -> list[str]:
    if not scores:
        return ["failed"] * len(TITLES)
    cells = [mean_spread([getattr(s, metric) for s in scores]) for metric in METRICS]
    closed = [100 * gap_closed({**controls, "dyfn": score}) for score in scores]
    return [*cells, mean_spread(closed, digits=0, unit="%")]


def mean_spread(values: Sequence[float], digits: int = 3, unit: str = "") -> str:
    """Mean ± standard deviation; the mean alone for a single value."""
    mean = f"{round(float(np.mean(values)), digits) + 0.0:.{digits}f}"  # + 0.0: no minus zero
    spread = f" ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else ""
    return f"{mean}{spread}{unit}"


def verdicts(
    controls: Mapping[str, Mapping[str, VariantScore]], arms: Mapping[str, ArmScores]
) -> list[str]:
    """A sentence per data set and arm: the first against the best control, others against it."""
    found = []
    for data, row in controls.items():
        first: list[float] = []
        for name, arm in arms.items():
            values = [score.video_abs_rel for score in arm.scores.get(data, [])]
            if not values:
                continue
            if not first:
                first, rival = values, min(("base", "ema", "frozen"), key=_video(row))
                found.append(f"{data}: {name} {_compare(values, [_video(row)(rival)], rival)}.")
            else:
                found.append(f"{data}: {name} {_compare(values, first, next(iter(arms)))}.")
    for name, arm in arms.items():
        found += [f"{name}, seed {seed}, failed: {why}." for seed, why in arm.failed.items()]
    return found


def _video(row: Mapping[str, VariantScore]) -> Callable[[str], float]:
    return lambda name: row[name].video_abs_rel


def _compare(ours: Sequence[float], theirs: Sequence[float], name: str) -> str:
    """How two sets of runs differ in video AbsRel, next to the spread of their seeds."""
    difference = float(np.mean(ours) - np.mean(theirs))
    spreads = [np.std(v, ddof=1) for v in (ours, theirs) if len(v) > 1]
    if not spreads:
        return f"{difference:+.3f} video AbsRel against {name} (one seed: no spread)"
    spread = float(max(spreads))
    judged = "within" if abs(difference) <= spread else "beyond"
    return (
        f"{difference:+.3f} video AbsRel against {name}, {judged} the seeds' spread ({spread:.3f})"
    )


def length_table(curves: Mapping[str, Mapping[int, Sequence[float]]]) -> str:
    """curves: row -> number of frames -> one value a seed."""
    lengths = sorted({length for row in curves.values() for length in row})
    head = ["video AbsRel of the first", *(f"{length} frames" for length in lengths)]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name, row in curves.items():
        cells = [mean_spread(row[length]) if length in row else "" for length in lengths]
        lines.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(lines)


def grid_table(grid: StatisticsGrid) -> str:
    """The ranges over the grid as Markdown."""
    table = grid_ranges(grid)
    lines = [f"| {' | '.join(table.header)} |", f"|{' --- |' * len(table.header)}"]
    lines += [f"| {' | '.join(format_cell(cell) for cell in row)} |" for row in table.rows]
    return "\n".join(lines)


def section(experiment: Experiment, body: Sequence[str], command: Sequence[str]) -> str:
    """The text of one experiment; `command` is the words that make its tables again."""
    paper = textwrap.fill(f"Paper: {experiment.paper}", TEXT_WIDTH)
    parts = [f"### {experiment.question}", *body, _shown_command(command), paper]
    return "\n\n".join(parts)


def _shown_command(words: Sequence[str]) -> str:
    """A command as an indented block; a long one is broken between its options."""
    options: list[str] = []
    for word in map(shlex.quote, words):
        if word.startswith("--") or not options:
            options.append(word)
        else:
            options[-1] += f" {word}"
    lines = [f"    {options[0]}"]
    for option in options[1:]:
        if len(lines[-1]) + len(option) + 3 > TEXT_WIDTH:
            lines.append(f"        {option}")
        else:
            lines[-1] += f" {option}"
    return " \\\n".join(lines)


def write_section(path: Path, name: str, text: str) -> None:
    """Replace what is between the markers of an experiment; a new one goes to the end.

    The rest of the file is not touched. Raises ValueError when a marker lacks its partner.
    """
    first, last = f"<!-- experiment: {name} -->", f"<!-- end of experiment: {name} -->"
    content = path.read_text(encoding="utf-8") if path.exists() else ""
    if (first in content) != (last in content):
        raise ValueError(f"{path}: only one of {first} and {last} is there")
    block = f"{first}\n{text}\n{last}"
    if first in content:
        pattern = re.escape(first) + r".*?" + re.escape(last)
        content = re.sub(pattern, lambda _: block, content, count=1, flags=re.DOTALL)
    else:
        if HEADING not in content.splitlines():
            content = f"{content.rstrip()}\n\n{HEADING}\n".lstrip()
        content = f"{content.rstrip()}\n\n{block}\n"
    write_text(path, content)
