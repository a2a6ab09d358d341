"""Small and middle-sized things of own making: what lies on desks and shelves, plants, curtains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dyfn_worlds.scene import textures
from dyfn_worlds.scene.builder import SceneBuilder, new_vertices

GREENS = np.array([[0.05, 0.16, 0.03], [0.10, 0.24, 0.05], [0.03, 0.10, 0.04], [0.16, 0.25, 0.08]])


@dataclass(frozen=True)
class Spot:
    """A place in a scene with axes of its own: x to the right of who faces it, y away, z up."""

    builder: SceneBuilder
    rng: np.random.Generator
    position: np.ndarray
    yaw: float

    def at(self, x: float, y: float, z: float = 0.0) -> np.ndarray:
        """Local metres -> world."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        result: np.ndarray = np.asarray(self.position) + np.array([c * x - s * y, s * x + c * y, z])
        return result

    def moved(self, x: float, y: float, z: float = 0.0, turn: float = 0.0) -> Spot:
        return Spot(self.builder, self.rng, self.at(x, y, z), self.yaw + turn)

    def layer(self, image: np.ndarray) -> int:
        return self.builder.texture(("clutter", int(self.rng.integers(1 << 30))), image)

    def box(
        self, x: float, y: float, z: float, size: tuple[float, float, float],
        layer: int, color: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """A box of size (along x, y, z) whose bottom is centred on local x, y, z."""
        half = np.array(size) / 2
        centre = self.at(x, y, z + half[2])
        self.builder.box(
            centre - half, centre + half, layer, self.yaw, color, metres_per_repeat=0.4
        )

    def panel(
        self, x: float, y: float, z: float, width: float, height: float, layer: int,
        lean: float = 0.0, emission: float = 0.0,
    ) -> None:  # fmt: skip
        """An upright quad that faces -y, its lower edge centred on x, y, z; lean tips it back."""
        back, up = height * np.sin(lean), height * np.cos(lean)
        corners = [(-width / 2, 0, 0), (width / 2, 0, 0), (width / 2, back, up),
                   (-width / 2, back, up)]  # fmt: skip
        world = np.array([self.at(x + a, y + b, z + c) for a, b, c in corners])
        self.builder.quad(world, layer, emission=emission)

    def sheet(self, x: float, y: float, z: float, size: tuple[float, float], layer: int) -> None:
        """A flat quad that faces up, centred on x, y, z."""
        a, b = size[0] / 2, size[1] / 2
        world = np.array(
            [self.at(x + u, y + v, z) for u, v in ((-a, -b), (a, -b), (a, b), (-a, b))]
        )
        self.builder.quad(world, layer)

    def cylinder(
        self, radii: tuple[float, float], height: float, color: np.ndarray, sides: int = 12
    ) -> None:
        """An upright one on the spot with a lid; radii below and above."""
        turn = np.arange(sides + 1) * 2 * np.pi / sides
        ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(sides + 1)], axis=1)
        vertices = new_vertices(3 * (sides + 1))
        low, high, lid = (slice(k * (sides + 1), (k + 1) * (sides + 1)) for k in range(3))
        for part, radius, z in ((low, radii[0], 0.0), (high, radii[1], height),
                                (lid, radii[1], height)):  # fmt: skip
            vertices["position"][part] = self.position + ring * radius + [0, 0, z]
            vertices["normal"][part] = ring if part is not lid else [0, 0, 1]
        vertices["uv"][low, 0] = vertices["uv"][high, 0] = np.arange(sides + 1) / sides
        vertices["uv"][high, 1] = 1
        vertices["color"] = color
        vertices["texture"] = self.builder.texture("plain", np.full((4, 4, 3), 255, np.uint8))
        i = np.arange(sides)
        wall = [[i, i + 1, i + sides + 1], [i + 1, i + sides + 2, i + sides + 1]]
        top = 2 * (sides + 1) + np.stack([np.zeros(sides, int), i, i + 1])
        triangles = np.concatenate([*(np.stack(w, axis=1) for w in wall), top.T])
        self.builder.add(vertices, triangles)


def monitor(spot: Spot) -> None:
    rng = spot.rng
    width = float(rng.uniform(0.42, 0.72))
    high, dark = width * float(rng.uniform(0.52, 0.64)), _plain(spot, rng.uniform(0.02, 0.2))
    spot.box(0, 0.03, 0, (0.22, 0.17, 0.012), dark)
    spot.box(0, 0.06, 0.01, (0.05, 0.025, 0.2), dark)
    spot.box(0, 0.03, 0.1, (width, 0.035, high), dark)
    on = rng.random() < 0.6
    image = textures.screen(rng) if on else np.full((4, 4, 3), 14, np.uint8)
    spot.panel(0, 0.03 - 0.019, 0.112, width - 0.024, high - 0.024, spot.layer(image),
               emission=float(rng.uniform(0.5, 2.0)) * on)  # fmt: skip


def laptop(spot: Spot) -> None:
    rng = spot.rng
    width, deep = float(rng.uniform(0.29, 0.38)), float(rng.uniform(0.2, 0.26))
    shell, lean = _plain(spot, rng.choice([0.05, 0.5, 0.75])), float(rng.uniform(0.1, 0.5))
    spot.box(0, 0, 0, (width, deep, 0.017), shell)
    spot.sheet(0, 0.02, 0.0185, (width * 0.9, deep * 0.6), spot.layer(textures.keys(rng)))
    spot.panel(0, deep / 2 + 0.006, 0.015, width, deep, shell, lean)
    spot.panel(0, deep / 2, 0.02, width * 0.95, deep * 0.93, spot.layer(textures.screen(rng)),
               lean, float(rng.uniform(0.5, 2.0)))  # fmt: skip


def keyboard(spot: Spot) -> None:
    width = float(spot.rng.choice([0.29, 0.44]))
    spot.box(0, 0, 0, (width, 0.13, 0.018), _plain(spot, spot.rng.choice([0.04, 0.6])))
    spot.sheet(0, 0, 0.0195, (width * 0.96, 0.118), spot.layer(textures.keys(spot.rng)))
    spot.moved(width / 2 + 0.1, 0).box(0, 0, 0, (0.06, 0.1, 0.03), _plain(spot, 0.1))


def papers(spot: Spot) -> None:
    layer = spot.layer(textures.document(spot.rng))
    thick = float(spot.rng.choice([0.002, 0.002, 0.01, 0.04]))
    sheet = (0.297, 0.21) if spot.rng.random() < 0.3 else (0.21, 0.297)
    spot.box(0, 0, 0, (*sheet, thick), _plain(spot, 0.85))
    spot.sheet(0, 0, thick + 0.001, sheet, layer)


def book_pile(spot: Spot) -> None:
    z = 0.0
    for _ in range(int(spot.rng.integers(1, 6))):
        thick, size = float(spot.rng.uniform(0.012, 0.05)), spot.rng.uniform(0.13, 0.3, 2)
        turned = spot.moved(0, 0, z, float(spot.rng.normal(0, 0.25)))
        turned.box(0, 0, 0, (float(size[0]), float(size.max()), thick), _cover(spot))
        z += thick


def mug(spot: Spot) -> None:
    color = textures.muted_color(spot.rng) ** 2
    spot.cylinder((0.034, 0.042), float(spot.rng.uniform(0.08, 0.12)), color)


def bottle(spot: Spot) -> None:
    radius, high = float(spot.rng.uniform(0.03, 0.045)), float(spot.rng.uniform(0.14, 0.24))
    color = textures.muted_color(spot.rng) ** 2
    spot.cylinder((radius, radius), high, color)
    spot.moved(0, 0, high).cylinder((radius, 0.013), 0.05, color)


def carton(spot: Spot) -> None:
    size = spot.rng.uniform([0.15, 0.12, 0.06], [0.4, 0.3, 0.3])
    spot.box(0, 0, 0, (float(size[0]), float(size[1]), float(size[2])), _cover(spot))


def binders(spot: Spot, length: float, height: float, deep: float) -> None:
    """Upright books or binders along x, `length` metres from the spot on."""
    rng, x = spot.rng, 0.0
    plain = _plain(spot, 1.0)
    while x < length:
        thick, tall = float(rng.uniform(0.015, 0.075)), height * float(rng.uniform(0.55, 0.95))
        if x + thick > length:
            return
        color = (textures.muted_color(rng) ** 2).astype(np.float32)
        push = float(rng.uniform(0, 0.05))
        spot.box(x + thick / 2, push, 0, (thick * 0.96, deep * 0.85, tall), plain, color)
        x += thick
        if rng.random() < 0.06:
            x += float(rng.uniform(0.05, 0.3))


def shelves(spot: Spot, size: tuple[float, float, float]) -> None:
    """An open bookcase of size (width, depth, height) with books, boxes and gaps."""
    rng, (width, deep, high) = spot.rng, size
    wooden = rng.random() < 0.6
    image = textures.wood(rng) if wooden else np.full((4, 4, 3), rng.integers(30, 240), np.uint8)
    layer, board = spot.layer(image), 0.022
    spot.box(0, deep / 2 - 0.005, 0, (width, 0.01, high), layer)
    for side in (-1, 1):
        spot.box(side * (width - board) / 2, 0, 0, (board, deep, high), layer)
    levels = max(2, int(high / rng.uniform(0.28, 0.42)))
    for level in range(levels + 1):
        z = level * (high - board) / levels
        spot.box(0, 0, z, (width, deep, board), layer)
        if level == levels and high > 1.6:
            continue
        room = (high - board) / levels - board
        inside = spot.moved(-width / 2 + board, 0, z + board)
        kind = rng.random()
        if kind < 0.55:
            binders(
                inside, (width - 2 * board) * rng.uniform(0.3, 1.0), min(room, 0.36), deep * 0.8
            )
        elif kind < 0.85:
            for x in np.arange(0.2, width - 0.2, 0.38):
                things = (carton, mug, book_pile, bottle, papers)
                things[rng.integers(len(things))](inside.moved(float(x), 0))


def plant(spot: Spot, height: float) -> None:
    """A pot with a bush of curved leaves, `height` metres in all."""
    rng = spot.rng
    pot = float(np.clip(height * rng.uniform(0.2, 0.4), 0.1, 0.6))
    radius = float(np.clip(height * rng.uniform(0.12, 0.2), 0.06, 0.24))
    spot.cylinder((radius * 0.8, radius), pot, textures.muted_color(rng) ** 2, 16)
    count = int(rng.integers(40, 160) * max(1.0, 1.5 * height))
    turn, rise = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.1, 1.3, count)
    base = rng.uniform(0, 0.55, count) * (height - pot) + pot
    long = (height - pot) * rng.uniform(0.25, 0.5, count)
    wide = long * rng.uniform(0.08, 0.3)
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    side = np.stack([-np.sin(turn), np.cos(turn), np.zeros(count)], axis=1)
    up = np.array([0, 0, 1.0])
    rows = []
    for t, share in ((0.0, 0.15), (0.35, 1.0), (0.7, 0.8), (1.0, 0.05)):
        reach = (t * np.cos(rise) * long)[:, None]
        lift = (base + long * (np.sin(rise) * t - 0.45 * t * t))[:, None]
        middle = np.asarray(spot.position) + out * (reach + 0.02) + lift * up
        rows += [
            middle - side * (wide * share / 2)[:, None],
            middle + side * (wide * share / 2)[:, None],
        ]
    points = np.stack(rows, axis=1)
    vertices = new_vertices(count * 8)
    vertices["position"] = points.reshape(-1, 3)
    vertices["normal"] = np.repeat(
        up * np.cos(rise)[:, None] - out * np.sin(rise)[:, None] + 1e-3, 8, 0
    )
    tone = GREENS[rng.integers(len(GREENS))] * rng.uniform(0.5, 1.6, (count, 1))
    vertices["color"] = np.repeat(tone, 8, axis=0)
    vertices["texture"] = spot.builder.texture("plain", np.full((4, 4, 3), 255, np.uint8))
    strip = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4], [4, 5, 6], [5, 7, 6]])
    triangles = (np.arange(count)[:, None, None] * 8 + strip).reshape(-1, 3)
    spot.builder.add(vertices, triangles)


def curtain(spot: Spot, width: float, height: float) -> None:
    """Folds of cloth along x that hang from `height` down to the spot."""
    rng, folds = spot.rng, max(3, int(width / 0.12))
    x = np.linspace(-width / 2, width / 2, folds * 4 + 1)
    y = 0.035 * np.sin(np.arange(len(x)) * np.pi / 2) - 0.06
    layer = spot.layer(textures.cloth(rng))
    low, high = 0.0, height
    for a in range(len(x) - 1):
        corners = [(x[a], y[a], low), (x[a + 1], y[a + 1], low), (x[a + 1], y[a + 1], high),
                   (x[a], y[a], high)]  # fmt: skip
        world = np.array([spot.at(float(p), float(q), r) for p, q, r in corners])
        spot.builder.quad(world, layer, (0.05, height / 0.5))


Thing = Callable[[Spot], None]
ON_DESKS: tuple[Thing, ...] = (
    laptop, keyboard, papers, papers, book_pile, mug, bottle, carton,
)  # fmt: skip
ON_TABLES: tuple[Thing, ...] = (laptop, papers, papers, book_pile, mug, mug, bottle, carton)


def _plain(spot: Spot, grey: float) -> int:
    level = int(np.clip(255 * np.sqrt(grey), 0, 255))
    return spot.builder.texture(("grey", level), np.full((4, 4, 3), level, np.uint8))


def _cover(spot: Spot) -> int:
    draw = (textures.picture, textures.plaster, textures.cardboard)[spot.rng.integers(3)]
    return spot.layer(draw(spot.rng))
