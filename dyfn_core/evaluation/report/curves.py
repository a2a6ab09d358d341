"""Curves and histograms of a report: inline SVG of bounded size."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from matplotlib.ticker import MaxNLocator

WIDTH, HEIGHT = 860, 210
LEFT, RIGHT, TOP, BOTTOM = 62, 850, 8, 182
BUCKETS = 400  # of a long curve; each keeps its lowest and its highest value
BARS = 40
COLOURS = 6
Point = tuple[int, float]


@dataclass(frozen=True)
class Curves:
    """Lines over the frames. lines: name -> a value per frame, None (or not finite) for a gap."""

    title: str
    lines: Mapping[str, Sequence[float | None] | np.ndarray]
    x_label: str = "frame"


@dataclass(frozen=True)
class Histogram:
    """How often values occur. values: name -> values in `unit`; marks: name -> places to mark."""

    title: str
    values: Mapping[str, Sequence[float] | np.ndarray]
    unit: str
    marks: Mapping[str, Mapping[str, float]]


def decimate(
    values: Sequence[float | None] | np.ndarray, buckets: int = BUCKETS
) -> list[list[Point]]:
    """Runs of (frame, value) without a gap inside; long curves keep each bucket's extremes.

    At most 2 * buckets points in all. A gap shorter than a bucket of a long curve is not seen.
    """
    found = np.array(values, np.float64)  # None becomes NaN
    known = np.flatnonzero(np.isfinite(found))
    size = max(1, math.ceil(len(found) / buckets)) if len(found) > 2 * buckets else 1
    runs: list[list[Point]] = []
    previous = -2
    for part in np.split(known, np.flatnonzero(np.diff(known // size)) + 1) if known.size else []:
        ends = {int(part[found[part].argmin()]), int(part[found[part].argmax()])}
        bucket = int(part[0]) // size
        if bucket != previous + 1:
            runs.append([])
        runs[-1] += [(place, float(found[place])) for place in sorted(ends)]
        previous = bucket
    return runs


def curves_html(part: Curves) -> str:
    """A figure; the data for the script is inside."""
    lines = {name: decimate(values) for name, values in part.lines.items()}
    points = [point for runs in lines.values() for run in runs for point in run]
    last = max([len(values) for values in part.lines.values()] or [1]) - 1
    low, high = _range([value for _, value in points])
    drawn = [_frame(0, max(last, 1), low, high)]
    for number, runs in enumerate(lines.values()):
        path = "".join(_path(run, last, low, high) for run in runs)
        drawn.append(f'<path class="plot" stroke="{_colour(number)}" d="{path}"/>')
    drawn.append(f'<line class="cursor" y1="{TOP}" y2="{BOTTOM}"/>')
    data = {
        "label": part.x_label,
        "last": max(last, 0),
        "box": {"left": LEFT, "right": RIGHT, "width": WIDTH},
        "lines": [
            {"name": name, "points": [[x, float(f"{y:.4g}")] for run in runs for x, y in run]}
            for name, runs in lines.items()
        ],
    }
    packed = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    return (
        f"<figure data-curve><figcaption>{escape(part.title)}</figcaption>{_legend(part.lines)}"
        f"{_svg(drawn, part.title, part.x_label)}"
        f'<div class="tip"></div><script type="application/json">{packed}</script></figure>'
    )


def histogram_html(part: Histogram) -> str:
    """A figure; the last bar holds all that is beyond it."""
    values = {name: np.asarray(v, np.float64) for name, v in part.values.items() if len(v)}
    if not values:
        return ""
    joined = np.concatenate(list(values.values()))
    low, high = float(joined.min()), float(np.percentile(joined, 99.5))
    high = max(high, low * 1.05 + 1e-9)
    edges = np.linspace(low, high, BARS + 1)
    shares = {n: np.histogram(np.minimum(v, high), edges)[0] / len(v) for n, v in values.items()}
    top = max(float(share.max()) for share in shares.values()) * 100
    drawn = [_frame(low, high, 0, top, integral=False)]
    for number, (name, share) in enumerate(shares.items()):
        steps = "".join(
            f"L{_x(a, low, high)} {_y(s * 100, 0, top)}L{_x(b, low, high)} {_y(s * 100, 0, top)}"
            for a, b, s in zip(edges, edges[1:], share, strict=False)
        )
        colour = _colour(number)
        drawn.append(
            f'<path d="M{LEFT} {BOTTOM}{steps}L{RIGHT} {BOTTOM}Z" fill="{colour}" '
            f'fill-opacity=".25" stroke="{colour}"/>'
        )
        for label, place in part.marks.get(name, {}).items():
            x = _x(min(place, high), low, high)
            drawn.append(
                f'<line x1="{x}" x2="{x}" y1="{TOP}" y2="{BOTTOM}" stroke="{colour}" '
                f'stroke-dasharray="4 3"/><text x="{x + 3:.1f}" y="{TOP + 11 + 13 * number}">'
                f"{escape(label)}</text>"
            )
    return (
        f"<figure><figcaption>{escape(part.title)}</figcaption>{_legend(values)}"
        f"{_svg(drawn, part.title, f'{part.unit} (height: % of the frames)')}</figure>"
    )


def _svg(drawn: list[str], title: str, x_label: str) -> str:
    label = f'<text x="{RIGHT}" y="{HEIGHT - 2}" text-anchor="end">{escape(x_label)}</text>'
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title, quote=True)}">'
        f"{''.join(drawn)}{label}</svg>"
    )


def _legend(lines: Mapping[str, object]) -> str:
    names = "".join(
        f'<i style="background:{_colour(number)}"></i>{escape(name)}'
        for number, name in enumerate(lines)
    )
    return f'<div class="legend">{names}</div>'


def _colour(number: int) -> str:
    return f"var(--c{number % COLOURS})"


def _range(values: list[float]) -> tuple[float, float]:
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    room = 0.06 * (high - low) or 0.06 * abs(high) or 1.0
    return low - room, high + room


def _frame(x0: float, x1: float, y0: float, y1: float, integral: bool = True) -> str:
    """Grid lines and the numbers at them."""
    parts = []
    for value in _ticks(y0, y1, 4, False):
        y = _y(value, y0, y1)
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="{RIGHT}" y1="{y}" y2="{y}"/>'
            f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:.5g}</text>'
        )
    for value in _ticks(x0, x1, 8, integral):
        x = _x(value, x0, x1)
        parts.append(f'<text x="{x}" y="{BOTTOM + 15}" text-anchor="middle">{value:.6g}</text>')
    return "".join(parts)


def _ticks(low: float, high: float, count: int, integral: bool) -> list[float]:
    ticks = MaxNLocator(count, integer=integral).tick_values(low, high)
    return [float(tick) + 0.0 for tick in ticks if low <= tick <= high]


def _x(value: float, low: float, high: float) -> float:
    return round(LEFT + (value - low) / (high - low) * (RIGHT - LEFT), 1)


def _y(value: float, low: float, high: float) -> float:
    return round(BOTTOM - (value - low) / (high - low) * (BOTTOM - TOP), 1)


def _path(run: list[Point], last: int, low: float, high: float) -> str:
    places = [f"{_x(x, 0, max(last, 1))} {_y(y, low, high)}" for x, y in run]
    if len(places) == 1:  # a lone value between gaps: a short stroke
        places.append(f"{_x(run[0][0], 0, max(last, 1)) + 1} {_y(run[0][1], low, high)}")
    return "M" + "L".join(places)
