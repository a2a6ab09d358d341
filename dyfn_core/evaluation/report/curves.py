"""Curves and histograms of a report: inline SVG of bounded size."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from matplotlib.ticker import MaxNLocator

WIDTH, HEIGHT = 860, 236
LEFT, RIGHT, TOP, BOTTOM = 66, 850, 30, 196
BUCKETS = 400  # of a long curve; each keeps its lowest and its highest value
BARS = 40
COLOURS = 6
MUTED = "var(--muted)"
DASHES = ("", "6 3", "2 3", "10 3 2 3")
CLIP = (
    '<svg class="defs" width="0" height="0"><clipPath id="plot"><rect '
    f'x="{LEFT}" y="{TOP}" width="{RIGHT - LEFT}" height="{BOTTOM - TOP}"/></clipPath></svg>'
)
Point = tuple[int, float]
Place = tuple[float, float]


@dataclass(frozen=True)
class Curves:
    """Lines over the frames.

    lines: name -> a value per frame, None (or not finite) for a gap. x: where each frame stands,
    in the unit of x_label and never falling; None: frames are counted. y_label: quantity and unit.
    muted: names of lines that are drawn grey and do not stretch the axis.
    """

    title: str
    lines: Mapping[str, Sequence[float | None] | np.ndarray]
    x_label: str = "frame"
    y_label: str = ""
    x: Sequence[float] | np.ndarray | None = None
    muted: Collection[str] = ()


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
    count = max([len(values) for values in part.lines.values()] or [1])
    places = np.arange(count) if part.x is None else np.asarray(part.x, np.float64)
    lines = {
        name: [[(float(places[at]), value) for at, value in run] for run in decimate(values)]
        for name, values in part.lines.items()
    }
    shown = [name for name in lines if name not in part.muted] or list(lines)
    low, high = _range([value for name in shown for run in lines[name] for _, value in run])
    start, end = _ends(places)
    drawn = [_frame(start, end, low, high, integral=part.x is None)]
    colours = line_colours(part.lines, part.muted)
    dashes = _dashes(lines, part.muted)
    for name in sorted(lines, key=lambda name: name not in part.muted):  # grey lies below
        path = "".join(_path(run, (start, end), (low, high)) for run in lines[name])
        drawn.append(
            f'<path class="plot" clip-path="url(#plot)" stroke="{colours[name]}" '
            f'stroke-dasharray="{dashes[name]}" d="{path}"/>'
        )
    drawn.append(f'<line class="cursor" y1="{TOP}" y2="{BOTTOM}"/>')
    box = {"left": LEFT, "right": RIGHT, "width": WIDTH}
    axis = json.dumps({"label": part.x_label, "ends": [start, end], "box": box})
    values = ",".join(_line_json(name, runs) for name, runs in lines.items())
    packed = f'{axis[:-1]},"lines":[{values}]}}'.replace("<", "\\u003c")
    return (
        f"<figure data-curve><figcaption>{escape(part.title)}</figcaption>"
        f"{_legend(colours, dashes)}{_svg(drawn, part.title, part.x_label, part.y_label)}"
        f'<div class="tip"></div><script type="application/json">{packed}</script></figure>'
    )


def line_colours(names: Iterable[str], muted: Collection[str] = ()) -> dict[str, str]:
    """The colour of each line, as CSS: its place among those that are not muted, else grey."""
    found: dict[str, str] = {}
    for name in names:
        used = sum(colour != MUTED for colour in found.values())
        found[name] = MUTED if name in muted else f"var(--c{used % COLOURS})"
    return found


def _ends(places: np.ndarray) -> tuple[float, float]:
    """First and last place, apart also where there is only one."""
    first = float(places[0]) if len(places) else 0.0
    last = float(places[-1]) if len(places) else 0.0
    return first, last if last > first else first + 1


def _line_json(name: str, runs: list[list[Place]]) -> str:
    """Text at once: nested lists of a long curve would be the largest thing of a report."""
    points = ",".join(f"[{x:.5g},{y:.5g}]" for run in runs for x, y in run)
    return f'{{"name":{json.dumps(name)},"points":[{points}]}}'


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
    colours = line_colours(values)
    for number, (name, share) in enumerate(shares.items()):
        steps = "".join(
            f"L{_x(a, low, high)} {_y(s * 100, 0, top)}L{_x(b, low, high)} {_y(s * 100, 0, top)}"
            for a, b, s in zip(edges, edges[1:], share, strict=False)
        )
        colour = colours[name]
        drawn.append(
            f'<path d="M{LEFT} {BOTTOM}{steps}L{RIGHT} {BOTTOM}Z" fill="{colour}" '
            f'fill-opacity=".25" stroke="{colour}"/>'
        )
        for label, place in part.marks.get(name, {}).items():
            x = _x(min(place, high), low, high)
            beside = f'x="{x + 3:.1f}"' if x < RIGHT - 40 else f'x="{x - 3:.1f}" text-anchor="end"'
            drawn.append(
                f'<line x1="{x}" x2="{x}" y1="{TOP}" y2="{BOTTOM}" stroke="{colour}" '
                f'stroke-dasharray="4 3"/><text {beside} y="{TOP + 11 + 13 * number}">'
                f"{escape(label)}</text>"
            )
    return (
        f"<figure><figcaption>{escape(part.title)}</figcaption>{_legend(colours, {})}"
        f"{_svg(drawn, part.title, part.unit, '% of the frames')}</figure>"
    )


def _svg(drawn: list[str], title: str, x_label: str, y_label: str) -> str:
    labels = (
        f'<text x="{RIGHT}" y="{HEIGHT - 4}" text-anchor="end">{escape(x_label)}</text>'
        f'<text x="2" y="15">{escape(y_label)}</text>'
    )
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title, quote=True)}">'
        f"{''.join(drawn)}{labels}</svg>"
    )


def _dashes(names: Iterable[str], muted: Collection[str]) -> dict[str, str]:
    """Grey lines are told apart by their dashes."""
    grey = (name for name in names if name in muted)
    return dict.fromkeys(names, "") | {
        name: DASHES[number % len(DASHES)] for number, name in enumerate(grey)
    }


def _legend(colours: Mapping[str, str], dashes: Mapping[str, str]) -> str:
    names = "".join(
        f'<span><svg viewBox="0 0 32 4"><path stroke="{colour}" stroke-width="3" '
        f'stroke-dasharray="{dashes.get(name, "")}" d="M0 2H32"/></svg>{escape(name)}</span>'
        for name, colour in colours.items()
    )
    return f'<div class="legend">{names}</div>'


def _range(values: list[float]) -> tuple[float, float]:
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    room = 0.06 * (high - low) or 0.06 * abs(high) or 1.0
    return low - room, high + room


def _frame(x0: float, x1: float, y0: float, y1: float, integral: bool) -> str:
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


def _path(run: list[Place], ends: tuple[float, float], span: tuple[float, float]) -> str:
    places = [f"{_x(x, *ends)} {_y(y, *span)}" for x, y in run]
    if len(places) == 1:  # a lone value between gaps: a short stroke
        places.append(f"{_x(run[0][0], *ends) + 1:.1f} {_y(run[0][1], *span)}")
    return "M" + "L".join(places)
