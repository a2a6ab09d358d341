"""Walls with doors and windows, floors and ceilings of a one-storey home."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dyfn_worlds.scene.builder import SceneBuilder

SKIRTING = (0.08, 0.014)  # height and thickness, metres
CASING = (0.07, 0.02)  # width and thickness of the boards around a door
WINDOW_FRAME = 0.06


@dataclass(frozen=True)
class Opening:
    """A hole in a wall, from `low` to `high` along it and from `sill` to `top` above the floor."""

    low: float
    high: float
    sill: float
    top: float

    @property
    def is_window(self) -> bool:
        """Whether it is glazed: the doors of this home have no threshold."""
        return self.sill > 0


@dataclass(frozen=True)
class Wall:
    """A straight wall of some thickness.

    axis: 0 when it runs along x, 1 along y. near, far: its two faces, coordinates of the other
    axis. start, end: along it. sides: layers of the texture on the near and on the far face, -1
    for outdoors.
    """

    axis: int
    near: float
    far: float
    start: float
    end: float
    sides: tuple[int, int]
    openings: Sequence[Opening] = field(default_factory=tuple)

    def at(self, along: float, across: float, z: float) -> np.ndarray:
        point = (along, across) if self.axis == 0 else (across, along)
        return np.array([*point, z])

    def box(
        self, builder: SceneBuilder, along: tuple[float, float], across: tuple[float, float],
        z: tuple[float, float], layer: int,
    ) -> None:  # fmt: skip
        low, high = self.at(along[0], across[0], z[0]), self.at(along[1], across[1], z[1])
        builder.box(low, high, layer, metres_per_repeat=0.6)


@dataclass(frozen=True)
class Finish:
    """Layers of what all rooms share."""

    trim: int
    outdoors: int


def build_wall(builder: SceneBuilder, wall: Wall, height: float, finish: Finish) -> None:
    """Both faces, the sides of its holes, skirting boards, door casings and window frames."""
    pieces = _pieces(wall, height)
    for (a, b), (low, high) in pieces:
        for face, outward, layer in ((wall.near, -1, wall.sides[0]), (wall.far, 1, wall.sides[1])):
            layer = finish.outdoors if layer < 0 else layer
            _face(builder, wall, (a, b), (low, high), face, outward, layer)
    for hole in wall.openings:
        _reveal(builder, wall, hole, finish)
        if hole.is_window:
            _window(builder, wall, hole, finish)
    for side, (face, outward) in zip(wall.sides, ((wall.near, -1), (wall.far, 1)), strict=True):
        if side >= 0:
            _trim(builder, wall, face, outward, finish)


def _pieces(wall: Wall, height: float) -> list[tuple[tuple[float, float], tuple[float, float]]]:
    """The wall's face without its holes, as rectangles."""
    pieces, at = [], wall.start
    for hole in sorted(wall.openings, key=lambda h: h.low):
        pieces.append(((at, hole.low), (0.0, height)))
        pieces.append(((hole.low, hole.high), (hole.top, height)))
        if hole.sill > 0:
            pieces.append(((hole.low, hole.high), (0.0, hole.sill)))
        at = hole.high
    pieces.append(((at, wall.end), (0.0, height)))
    return [piece for piece in pieces if piece[0][1] - piece[0][0] > 1e-6]


def _face(
    builder: SceneBuilder, wall: Wall, along: tuple[float, float], z: tuple[float, float],
    across: float, outward: int, layer: int,
) -> None:  # fmt: skip
    """One rectangle that is seen from its outward side; the texture runs on between them."""
    (a, b), (low, high) = along, z
    rightwards = (outward > 0) == (wall.axis == 1)
    first, last = (a, b) if rightwards else (b, a)
    corners = np.array(
        [wall.at(first, across, low), wall.at(last, across, low),
         wall.at(last, across, high), wall.at(first, across, high)]
    )  # fmt: skip
    repeat = 1.6
    builder.quad(corners, layer, ((b - a) / repeat, (high - low) / repeat))


def _reveal(builder: SceneBuilder, wall: Wall, hole: Opening, finish: Finish) -> None:
    """The four (a door: three) sides of a hole, as thin boards of the trim's colour."""
    thin, faces = 0.012, (wall.near, wall.far)
    for edge, inward in ((hole.low, 1), (hole.high, -1)):
        wall.box(builder, tuple(sorted((edge, edge + inward * thin))), faces,
                 (hole.sill, hole.top), finish.trim)  # fmt: skip
    wall.box(builder, (hole.low, hole.high), faces, (hole.top - thin, hole.top), finish.trim)
    if hole.is_window:
        wall.box(builder, (hole.low, hole.high), faces, (hole.sill, hole.sill + thin), finish.trim)


def _window(builder: SceneBuilder, wall: Wall, hole: Opening, finish: Finish) -> None:
    """A frame with a post in the middle, nearer to the outside, and a sill indoors."""
    outside_far = wall.sides[1] < 0
    outer, inner = (wall.far, wall.near) if outside_far else (wall.near, wall.far)
    middle = outer + 0.35 * (inner - outer)
    depth = (middle - 0.03, middle + 0.03)
    f = WINDOW_FRAME
    posts = [hole.low, (hole.low + hole.high - f) / 2, hole.high - f]
    for post in posts:
        wall.box(builder, (post, post + f), depth, (hole.sill, hole.top), finish.trim)
    for rail in (hole.sill, hole.top - f):
        wall.box(builder, (hole.low, hole.high), depth, (rail, rail + f), finish.trim)
    if hole.sill > 0.3:
        into = inner + (0.07 if outside_far is False else -0.07)
        wall.box(builder, (hole.low - 0.06, hole.high + 0.06), tuple(sorted((middle, into))),
                 (hole.sill - 0.03, hole.sill), finish.trim)  # fmt: skip


def _trim(builder: SceneBuilder, wall: Wall, face: float, outward: int, finish: Finish) -> None:
    """Skirting boards between the doors, and the boards around each door."""
    high, thick = SKIRTING
    doors = sorted((h for h in wall.openings if not h.is_window), key=lambda h: h.low)
    width, deep = CASING
    across = tuple(sorted((face, face + outward * thick)))
    at = wall.start
    for door in doors:
        wall.box(builder, (at, door.low - width), across, (0, high), finish.trim)
        at = door.high + width
        proud = tuple(sorted((face, face + outward * deep)))
        for low in (door.low - width, door.high):
            wall.box(builder, (low, low + width), proud, (0, door.top + width), finish.trim)
        wall.box(builder, (door.low, door.high), proud, (door.top, door.top + width), finish.trim)
    wall.box(builder, (at, wall.end), across, (0, high), finish.trim)


def build_floor(
    builder: SceneBuilder, low: tuple[float, float], high: tuple[float, float],
    layer: int, repeat: float, z: float = 0.0,
) -> None:  # fmt: skip
    """A level rectangle that is seen from above."""
    (x0, y0), (x1, y1) = low, high
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    builder.quad(corners, layer, ((x1 - x0) / repeat, (y1 - y0) / repeat))


def build_ceiling(
    builder: SceneBuilder, low: tuple[float, float], high: tuple[float, float], layer: int, z: float
) -> None:
    """A level rectangle that is seen from below."""
    (x0, y0), (x1, y1) = low, high
    corners = np.array([[x0, y1, z], [x1, y1, z], [x1, y0, z], [x0, y0, z]])
    builder.quad(corners, layer, ((x1 - x0) / 1.6, (y1 - y0) / 1.6))
