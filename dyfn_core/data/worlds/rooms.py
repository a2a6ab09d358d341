"""Furnished rooms: a random floor plan, materials, furniture, clutter, windows and lamps."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from dyfn_core.data.worlds import textures
from dyfn_core.data.worlds.furniture import Piece, Showroom
from dyfn_core.data.worlds.scene import Light, Scene, SceneBuilder

TOPS = re.compile(
    r"table|desk|cabinet|counter|chest|dresser|drawer|console|nightstand|sideboard|bookcase|shel|"
    r"stool|fridge|oven|washer|worktop|buffet",
    re.IGNORECASE,
)
KINDS: dict[str, tuple[str, ...]] = {
    "living": ("Living room", "Living room", "Lights", "Miscellaneous"),
    "office": ("Office", "Office", "Living room", "Miscellaneous"),
    "kitchen": ("Kitchen", "Kitchen", "Living room"),
    "bedroom": ("Bedroom", "Bedroom", "Living room", "Lights"),
    "bathroom": ("Bathroom", "Bathroom", "Miscellaneous"),
    "storage": ("Miscellaneous", "Exterior", "Vehicles", "Office"),
}


@dataclass
class Room:
    """One box of a room while it is being filled. size: (x, y, z) metres from the origin."""

    rng: np.random.Generator
    size: np.ndarray
    builder: SceneBuilder = field(default_factory=SceneBuilder)
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def fits(self, x: float, y: float, half_x: float, half_y: float) -> bool:
        """Whether a footprint (centre, half sizes) is inside and free."""
        inside = half_x <= x <= self.size[0] - half_x and half_y <= y <= self.size[1] - half_y
        return inside and all(
            abs(x - a) > half_x + c or abs(y - b) > half_y + d for a, b, c, d in self.taken
        )

    def wall_spot(self, width: float, depth: float) -> tuple[float, float, float]:
        """A random place with its back to a wall: x, y, yaw (the back is towards +y at yaw 0)."""
        wall = int(self.rng.integers(4))
        length = self.size[0] if wall in (0, 2) else self.size[1]
        along = self.rng.uniform(width / 2, max(length - width / 2, width / 2 + 1e-3))
        off = depth / 2 + 0.01
        return [
            (along, self.size[1] - off, 0.0),
            (off, along, np.pi / 2),
            (along, off, np.pi),
            (self.size[0] - off, along, -np.pi / 2),
        ][wall]


def furnished_room(
    rng: np.random.Generator, showroom: Showroom | None, pool: list[np.ndarray]
) -> Scene:
    """A random room. Without a showroom it holds only boxes and pictures (own procedural art).

    pool: images for posters, boxes and some surfaces; may be empty.
    """
    large = rng.random() < 0.3
    size = rng.uniform([2.4, 2.6, 2.3], [8.5, 11.0, 3.6] if large else [5.0, 6.0, 2.9])
    room = Room(rng, size)
    _shell(room, pool)
    if rng.random() < 0.35:
        _partition(room)
    if showroom is not None:
        _furnish(room, showroom, pool)
    _boxes(room, pool, int(rng.poisson(3 if showroom else 9)))
    return room.builder.build(
        lights=_lights(room),
        ambient=(rng.uniform(0.1, 0.5) * (0.75 + 0.5 * rng.random(3))).astype(np.float32),
        viewpoints=np.column_stack(
            [rng.uniform(0.4, size[:2] - 0.4, (40, 2)), np.full(40, size[2] - 0.9)]
        ),
        name="room",
    )


def _image(rng: np.random.Generator, pool: list[np.ndarray], share: float) -> np.ndarray:
    if pool and rng.random() < share:
        return pool[rng.integers(len(pool))]
    return textures.picture(rng) if rng.random() < 0.7 else textures.books(rng)


def _surface(room: Room, pool: list[np.ndarray], kind: str) -> int:
    rng = room.rng
    if kind == "wall":
        image = textures.plaster(rng) if rng.random() < 0.7 else textures.material(rng)
    elif kind == "ceiling":
        image = textures.plaster(rng) if rng.random() < 0.6 else textures.tiles(rng)
        image = (255 - (255 - image.astype(np.float32)) * 0.4).astype(np.uint8)
    else:
        image = textures.material(rng)
    if pool and rng.random() < 0.08:
        image = pool[rng.integers(len(pool))]
    return room.builder.texture((kind, int(rng.integers(1 << 30))), image)


def _shell(room: Room, pool: list[np.ndarray]) -> None:
    rng, build, (x, y, z) = room.rng, room.builder, room.size
    floor, ceiling = _surface(room, pool, "floor"), _surface(room, pool, "ceiling")
    repeat = float(rng.uniform(0.5, 2.5))
    build.quad(
        np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]]), floor, (x / repeat, y / repeat)
    )
    build.quad(np.array([[0, y, z], [x, y, z], [x, 0, z], [0, 0, z]]), ceiling, (x / 1.2, y / 1.2))
    corners = np.array([[0, 0], [x, 0], [x, y], [0, y]])
    wall = _surface(room, pool, "wall")
    for side in range(4):
        a, b = corners[side], corners[(side + 1) % 4]
        layer = _surface(room, pool, "wall") if rng.random() < 0.2 else wall
        length = float(np.linalg.norm(b - a))
        build.quad(np.array([[*b, 0], [*a, 0], [*a, z], [*b, z]]), layer, (length / 2.0, z / 2.0))
        _hang(room, a, b, pool)


def _hang(room: Room, a: np.ndarray, b: np.ndarray, pool: list[np.ndarray]) -> None:
    """Windows, posters, boards, a skirting board on the wall from a to b (inside on its left)."""
    rng, build, height = room.rng, room.builder, room.size[2]
    along = (b - a) / np.linalg.norm(b - a)
    inward = np.array([-along[1], along[0]])
    length = float(np.linalg.norm(b - a))

    def panel(start: float, width: float, low: float, high: float, layer: int,
              off: float, emission: float) -> None:  # fmt: skip
        p, q = a + along * start + inward * off, a + along * (start + width) + inward * off
        build.quad(np.array([[*q, low], [*p, low], [*p, high], [*q, high]]), layer,
                   emission=emission)  # fmt: skip

    if rng.random() < 0.6:
        skirting = build.texture("skirting", textures.plaster(rng))
        panel(0, length, 0, rng.uniform(0.05, 0.15), skirting, 0.012, 0)
    if rng.random() < 0.4 and length > 1.5:
        count, low = int(rng.integers(1, 4)), rng.uniform(0.1, 1.1)
        width = min(rng.uniform(0.6, 1.8), 0.8 * length / count)
        frame = build.texture("frame", textures.plaster(rng))
        view = build.texture(("window", id(rng)), textures.window(rng))
        high, glow = min(low + rng.uniform(0.8, 1.8), height - 0.1), rng.uniform(0.5, 5.0)
        for i in range(count):
            start = length * (i + 0.5) / count - width / 2
            panel(start - 0.06, width + 0.12, low - 0.06, high + 0.06, frame, 0.02, 0)
            panel(start, width, low, high, view, 0.025, glow)
        return
    for _ in range(int(rng.poisson(1.2))):
        width, tall = rng.uniform(0.2, min(1.6, 0.8 * length)), rng.uniform(0.2, 1.1)
        low = rng.uniform(0.7, max(height - tall - 0.1, 0.8))
        layer = build.texture(("hung", int(rng.integers(1 << 30))), _image(rng, pool, 0.6))
        start, off = rng.uniform(0, length - width), rng.uniform(0.01, 0.05)
        panel(start, width, low, low + tall, layer, off, rng.choice([0, 0, 0, 1.5]))


def _partition(room: Room) -> None:
    """A wall, half-high screen or pillar that stands in the room."""
    rng, (x, y, z) = room.rng, room.size
    layer = room.builder.texture("partition", textures.material(rng))
    for _ in range(int(rng.integers(1, 3))):
        high = z if rng.random() < 0.5 else rng.uniform(1.0, 1.8)
        across = rng.random() < 0.5
        thick, long = rng.uniform(0.06, 0.4), rng.uniform(0.3, 0.55) * (x if across else y)
        size = np.array([long, thick] if across else [thick, long])
        low = rng.random(2) * (np.array([x, y]) - size)
        room.builder.box(np.array([*low, 0]), np.array([*(low + size), high]), layer)
        room.taken.append((*(low + size / 2), *(size / 2)))


def _furnish(room: Room, showroom: Showroom, pool: list[np.ndarray]) -> None:
    rng = room.rng
    categories = KINDS[str(rng.choice(list(KINDS)))]
    pieces = [p for c in categories for p in showroom.of(c)]
    small = [p for p in showroom.pieces if max(p.size) < 0.6 and not p.is_opening]
    for piece in rng.permutation(np.array(showroom.openings(), dtype=object))[:2]:
        x, y, yaw = room.wall_spot(piece.size[0], piece.size[1])
        if piece.size[2] + piece.elevation < room.size[2]:
            _put(room, showroom, piece, np.array([x, y, piece.elevation]), yaw, pool)
            room.taken.append((x, y, 0.5, 0.5))
    area = float(room.size[0] * room.size[1])
    people = showroom.of("Characters")
    for _ in range(int(area * rng.uniform(0.6, 2.4)) + 3):
        piece = pieces[rng.integers(len(pieces))]
        if people and rng.random() < 0.03:
            piece = people[rng.integers(len(people))]
        if max(piece.size[:2]) < 0.25 or piece.size[2] + piece.elevation > room.size[2]:
            continue
        _stand(room, showroom, piece, small, pool)


def _stand(
    room: Room, showroom: Showroom, piece: Piece, small: list[Piece], pool: list[np.ndarray]
) -> None:
    rng, (width, depth, height) = room.rng, piece.size
    if rng.random() < 0.65 or piece.elevation > 0.5:
        x, y, yaw = room.wall_spot(width, depth)
    else:
        x, y = rng.random(2) * room.size[:2]
        yaw = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.2)
    c, s = abs(np.cos(yaw)), abs(np.sin(yaw))
    half = (c * width + s * depth) / 2 - 1e-3, (s * width + c * depth) / 2 - 1e-3
    if not room.fits(x, y, *half):
        return
    if not _put(room, showroom, piece, np.array([x, y, piece.elevation]), yaw, pool):
        return
    if piece.elevation < 0.5:
        room.taken.append((x, y, *half))
    if TOPS.search(piece.name) and 0.3 < height < 1.5 and piece.elevation < 0.3:
        for _ in range(int(rng.poisson(2.5))):
            item = small[rng.integers(len(small))]
            local = rng.uniform(-0.4, 0.4, 2) * [width, depth]
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            spot = np.array([*(np.array([x, y]) + turn @ local), height + piece.elevation])
            _put(room, showroom, item, spot, yaw + rng.normal(0, 0.6), pool)


def _put(
    room: Room, showroom: Showroom, piece: Piece, position: np.ndarray, yaw: float,
    pool: list[np.ndarray],
) -> bool:  # fmt: skip
    rng, images = room.rng, {}
    for index, part in enumerate(showroom.parts(piece)):
        if rng.random() < (0.12 if part.image is not None else 0.45):
            own = pool and rng.random() < 0.15
            images[index] = pool[rng.integers(len(pool))] if own else textures.material(rng)
    tint = np.clip(rng.lognormal(0.1, 0.35) * rng.normal(1, 0.08, 3), 0.2, 2.5)
    return showroom.place(room.builder, piece, position, yaw, tint, images)


def _boxes(room: Room, pool: list[np.ndarray], count: int) -> None:
    """Cartons, books, plinths: boxes on the floor, some stacked."""
    rng = room.rng
    for _ in range(count):
        half = rng.uniform(0.08, 0.5, 2) * rng.choice([0.5, 1.0, 1.6])
        x, y = rng.uniform(half, np.maximum(room.size[:2] - half, half + 1e-3))
        if not room.fits(x, y, *half):
            continue
        room.taken.append((x, y, *half))
        base, yaw = 0.0, rng.uniform(0, np.pi)
        for _ in range(int(rng.choice([1, 1, 2, 3]))):
            high = base + float(rng.uniform(0.08, 0.9))
            if high > room.size[2] - 0.5:
                break
            image = textures.material(rng) if rng.random() < 0.6 else _image(rng, pool, 0.5)
            layer = room.builder.texture(("box", int(rng.integers(1 << 30))), image)
            low = np.array([x - half[0], y - half[1], base])
            top = np.array([x + half[0], y + half[1], high])
            room.builder.box(low, top, layer, yaw, metres_per_repeat=float(rng.uniform(0.3, 1.2)))
            base, half, yaw = high, half * rng.uniform(0.5, 0.95), yaw + rng.normal(0, 0.3)


def _lights(room: Room) -> list[Light]:
    """One to three lamps under the ceiling, and perhaps the sun through a window."""
    rng, size = room.rng, room.size
    lights = []
    for _ in range(int(rng.integers(1, 4))):
        position = np.array(
            [*rng.uniform(0.2, 0.8, 2) * size[:2], size[2] - rng.uniform(0.05, 0.4)]
        )
        direction = np.array([*rng.normal(0, 0.15, 2), -1.0])
        warm = np.array([1.0, rng.uniform(0.75, 1.0), rng.uniform(0.5, 1.05)])
        color, cone = warm * rng.uniform(1.5, 7.0), float(rng.uniform(120, 170))
        lights.append(Light(position, direction / np.linalg.norm(direction), color, cone))
    if rng.random() < 0.5:
        side = rng.integers(4)
        edge = [(0.02, 0.5), (0.98, 0.5), (0.5, 0.02), (0.5, 0.98)][side]
        position = np.array([*np.array(edge) * size[:2], rng.uniform(1.2, 2.2)])
        aim = np.array([*rng.uniform(0.2, 0.8, 2) * size[:2], 0.2]) - position
        color = np.array([0.95, 1.0, 1.1]) * rng.uniform(3, 14)
        lights.append(
            Light(position, aim / np.linalg.norm(aim), color, float(rng.uniform(60, 140)))
        )
    return lights
