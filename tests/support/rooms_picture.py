"""Draw docs/pictures/rooms.svg from the import rules: `python -m tests.support.rooms_picture`."""

from __future__ import annotations

from collections.abc import Mapping, Set
from html import escape
from itertools import pairwise
from pathlib import Path

from tests.core.test_layering import ABOVE, HOMES, ROOMS

PICTURE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "rooms.svg"
BOX_WIDTH, BOX_HEIGHT, ROW, GAP, MARGIN = 130, 40, 84, 14, 20
LANE = 26  # width that an arrow takes where it passes a row
HEAD = 34  # height of a package's title
OUTSIDE = ("rclpy", "rosbags", "mcap", "apsw")

Node = tuple[str, ...]  # the rooms in one box; (importer, imported, level) for a passing arrow


def grouped(package: str) -> dict[Node, set[Node]]:
    """Boxes of a package -> the boxes that they may import, without what follows from others."""
    rooms = ROOMS[package]
    above = tuple(sorted(ABOVE[package]))
    plain = {room for room in rooms if not rooms[room] and not _is_folder(package, room)}
    box = {
        room: tuple(r for r in rooms if r in plain) if room in plain else (room,) for room in rooms
    }
    edges = {box[room]: {box[other] for other in rooms[room]} - {box[room]} for room in rooms}
    if above:
        edges[above] = set(edges)
    return {node: _direct(edges, node) for node in edges}


def _is_folder(package: str, room: str) -> bool:
    return (PICTURE.parents[2] / package / room).is_dir()


def _direct(edges: Mapping[Node, Set[Node]], node: Node) -> set[Node]:
    """The imports of a node that no other import of it reaches."""
    return {
        other
        for other in edges[node]
        if not any(other in _reached(edges, third) for third in edges[node] - {other})
    }


def _reached(edges: Mapping[Node, Set[Node]], node: Node) -> set[Node]:
    return set().union(edges[node], *(_reached(edges, other) for other in edges[node]))


def levels(edges: Mapping[Node, Set[Node]]) -> dict[Node, int]:
    """Node -> length of the longest chain of imports below it."""

    def level(node: Node) -> int:
        return max((level(other) + 1 for other in edges[node]), default=0)

    return {node: level(node) for node in edges}


def placed(edges: Mapping[Node, Set[Node]]) -> tuple[dict[Node, float], dict[Node, int], float]:
    """x of the middle of every box and passing arrow, their levels, and the width of all."""
    level = levels(edges)
    below: dict[Node, set[Node]] = {node: set() for node in edges}
    for node, others in edges.items():
        for other in others:
            chain = [(*node, *other, str(n)) for n in range(level[node] - 1, level[other], -1)]
            level |= {lane: int(lane[-1]) for lane in chain}
            for upper, lower in zip([node, *chain], [*chain, other], strict=True):
                below.setdefault(upper, set()).add(lower)
    x: dict[Node, float] = {}
    for row in range(max(level.values()) + 1):
        nodes = [node for node in level if level[node] == row]
        if row:
            nodes.sort(key=lambda n: sum(x[o] for o in below[n]) / len(below[n]))
        widths = [box_width(node) if node in edges else LANE for node in nodes]
        left = -(sum(widths) + GAP * (len(widths) - 1)) / 2
        for node, width in zip(nodes, widths, strict=True):
            x[node] = left + width / 2
            left += width + GAP
    reach = max(abs(x[node]) + box_width(node) / 2 for node in edges)
    return x, level, 2 * reach


def box_width(node: Node) -> float:
    return max(BOX_WIDTH, 7.2 * len(", ".join(node)) + 20)


def outside(package: str, node: Node) -> str:
    """The packages from outside that may be imported in this box only."""
    names = [
        name
        for names, homes in HOMES.items()
        for name in names
        if name in OUTSIDE and any(f"{package}.{room}" in homes for room in node)
    ]
    return ", ".join(names)


def package_drawing(package: str, left: float, bottom: float) -> tuple[list[str], float, float]:
    """SVG elements of one package, its width and its height."""
    edges = grouped(package)
    x, level, width = placed(edges)
    height = HEAD + 2 * MARGIN + max(level.values()) * ROW + BOX_HEIGHT
    middle = left + MARGIN + width / 2

    def top(node: Node) -> float:
        return bottom - MARGIN - BOX_HEIGHT - level[node] * ROW

    parts = [
        f'<rect class="package" x="{left:g}" y="{bottom - height:g}" '
        f'width="{width + 2 * MARGIN:g}" height="{height:g}" rx="8"/>',
        f'<text class="title" x="{left + MARGIN:g}" y="{bottom - height + 24:g}">{package}</text>',
    ]
    for node, others in edges.items():
        for other in sorted(others):
            lanes = [(*node, *other, str(n)) for n in range(level[node] - 1, level[other], -1)]
            points = [(middle + x[node], top(node) + BOX_HEIGHT)]
            for lane in lanes:
                points += [
                    (middle + x[lane], top(lane)),
                    (middle + x[lane], top(lane) + BOX_HEIGHT),
                ]
            points.append((middle + x[other], top(other)))
            parts.append(f'<path class="arrow" d="{curve(points)}"/>')
    for node in edges:
        parts += box(node, outside(package, node), middle + x[node], top(node))
    return parts, width + 2 * MARGIN, height


def curve(points: list[tuple[float, float]]) -> str:
    """A line down through the points: curved between rows, straight through a row."""
    path = [f"M{points[0][0]:.1f} {points[0][1]:.1f}"]
    for (x0, y0), (x1, y1) in pairwise(points):
        half = (y1 - y0) / 2
        path.append(f"C{x0:.1f} {y0 + half:.1f} {x1:.1f} {y1 - half:.1f} {x1:.1f} {y1:.1f}")
    return "".join(path)


def box(node: Node, uses: str, x: float, y: float) -> list[str]:
    width = box_width(node)
    text = y + (17 if uses else 25)
    parts = [
        f'<rect class="room" x="{x - width / 2:.1f}" y="{y:g}" width="{width:.1f}" '
        f'height="{BOX_HEIGHT}" rx="5"/>',
        f'<text x="{x:.1f}" y="{text:g}">{escape(", ".join(node))}</text>',
    ]
    if uses:
        parts.append(f'<text class="uses" x="{x:.1f}" y="{y + 32:g}">{escape(uses)}</text>')
    return parts


STYLE = """
.paper { fill: #ffffff }
.package { fill: #f4f6f8; stroke: #b8c2cc }
.room { fill: #ffffff; stroke: #44546a; stroke-width: 1.3 }
.arrow { fill: none; stroke: #6b7c93; stroke-width: 1.3; marker-end: url(#head) }
.between { fill: none; stroke: #2f5f9e; stroke-width: 3; marker-end: url(#head) }
text { font: 13px sans-serif; text-anchor: middle; fill: #1c2733 }
.title { font-weight: bold; font-size: 15px; text-anchor: start }
.uses { font-size: 11px; fill: #2f5f9e }
"""


def picture() -> str:
    """The whole drawing: the library, what stands on it, and the renderer beside them."""
    drawn = {package: package_drawing(package, 0, 0) for package in ROOMS}
    bottom = max(height for _, _, height in drawn.values()) + MARGIN
    left, parts = float(MARGIN), []
    edge: dict[str, tuple[float, float]] = {}
    for package, (_, width, _) in drawn.items():
        parts += package_drawing(package, left, bottom)[0]
        edge[package] = (left, left + width)
        left += width + 3 * MARGIN
    y = bottom - 70
    parts.append(
        f'<path class="between" d="M{edge["dyfn_ros"][0]:g} {y:g}H{edge["dyfn_core"][1] + 8:g}"/>'
    )
    width, height = left - 2 * MARGIN, bottom + MARGIN
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}">',
            f"<style>{STYLE}</style>",
            '<defs><marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" '
            'markerHeight="8" orient="auto" markerUnits="userSpaceOnUse">'
            '<path d="M0 0L8 4L0 8z" fill="#44546a"/></marker></defs>',
            f'<rect class="paper" width="{width:g}" height="{height:g}"/>',
            *parts,
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
