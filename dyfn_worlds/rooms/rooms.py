"""Furnished rooms: a random floor plan, materials, furniture, clutter, windows and lamps."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from dyfn_worlds.rooms import clutter, groups
from dyfn_worlds.rooms.furniture import Piece, Showroom
from dyfn_worlds.rooms.room import Room
from dyfn_worlds.scene import textures
from dyfn_worlds.scene.palette import Palette
from dyfn_worlds.scene.scene import Light, Scene, Window

TOPS = re.compile(
    r"table|desk|cabinet|counter|chest|dresser|drawer|console|nightstand|sideboard|bookcase|shel|"
    r"stool|fridge|oven|washer|worktop|buffet",
    re.IGNORECASE,
)
SUN_DISTANCE = 15.0
CHANCES = {
    "office": 0.42, "living": 0.18, "kitchen": 0.16, "bedroom": 0.09, "bathroom": 0.05,
    "storage": 0.1,
}  # fmt: skip
KINDS: dict[str, tuple[str, ...]] = {
    "living": ("Living room", "Living room", "Lights", "Miscellaneous"),
    "office": ("Office", "Office", "Living room", "Miscellaneous"),
    "kitchen": ("Kitchen", "Kitchen", "Living room"),
    "bedroom": ("Bedroom", "Bedroom", "Living room", "Lights"),
    "bathroom": ("Bathroom", "Bathroom", "Miscellaneous"),
    "storage": ("Miscellaneous", "Exterior", "Vehicles", "Office"),
}


def furnished_room(
    rng: np.random.Generator, showroom: Showroom | None, palette: Palette | None = None
) -> Scene:
    """A random room. Without a showroom it holds only boxes and pictures (own procedural art).

    palette: what surfaces, posters and windows show; own procedural art without one.
    """
    large = rng.random() < 0.4
    size = rng.uniform([2.6, 2.8, 2.35], [8.5, 11.0, 3.6] if large else [5.2, 6.5, 2.9])
    room = Room(rng, size, showroom, palette or Palette())
    lights = _lamps(room)
    _shell(room)
    lights += _daylight(room)
    if rng.random() < 0.3:
        _partition(room)
    kind = str(rng.choice(list(CHANCES), p=list(CHANCES.values())))
    if showroom is not None:
        _openings(room, showroom)
    _groups(room, kind)
    if showroom is not None:
        _furnish(room, showroom, kind)
    _boxes(room, int(rng.poisson(1.5 if showroom else 6)))
    return room.builder.build(
        lights=lights,
        ambient=(rng.uniform(0.15, 0.6) * (0.88 + 0.24 * rng.random(3))).astype(np.float32),
        viewpoints=np.column_stack(
            [rng.uniform(0.4, size[:2] - 0.4, (40, 2)), np.full(40, size[2] - 0.9)]
        ),
        interests=np.array(room.interests).reshape(-1, 3),
        name="room",
    )


def _groups(room: Room, kind: str) -> None:
    """Groups of furniture as the kind of room has them, the biggest first."""
    rng, area = room.rng, float(room.size[0] * room.size[1])
    many = max(1, int(area / 14))
    if kind == "office":
        for _ in range(int(rng.integers(1, many + 2))):
            groups.desks(room)
    tables = {"office": 0.5, "living": 0.6, "kitchen": 0.85, "storage": 0.3}.get(kind, 0.15)
    for _ in range(many):
        if rng.random() < tables:
            groups.meeting_table(room)
    if rng.random() < {"office": 0.3, "living": 0.9}.get(kind, 0.15):
        groups.sofa_corner(room)
    for _ in range(int(rng.poisson(1.0 + 0.04 * area))):
        groups.bookcase(room)
    for _ in range(int(rng.poisson({"kitchen": 2.0, "office": 1.2}.get(kind, 0.6)))):
        groups.cupboards(room)
    for _ in range(int(rng.poisson(0.5 + 0.03 * area))):
        groups.big_plant(room)


def _surface(room: Room, kind: str) -> int:
    rng, palette = room.rng, room.palette
    chance = rng.random()
    if kind == "wall":
        rough = textures.plaster if chance < 0.75 else textures.material
        image = textures.paint(rng) if chance < 0.5 else palette.surface(rng, rough)
    elif kind == "ceiling":
        image = textures.paint(rng) if chance < 0.75 else textures.tiles(rng)
        image = (255 - (255 - image.astype(np.float32)) * 0.4).astype(np.uint8)
    else:
        usual = textures.carpet if chance < 0.4 else textures.wood
        image = palette.surface(rng, usual if chance < 0.75 else textures.material)
    return room.builder.texture((kind, int(rng.integers(1 << 30))), image)


def _shell(room: Room) -> None:
    rng, build, (x, y, z) = room.rng, room.builder, room.size
    floor, ceiling = _surface(room, "floor"), _surface(room, "ceiling")
    repeat = float(rng.uniform(0.5, 2.5))
    build.quad(
        np.array([[0, 0, 0], [x, 0, 0], [x, y, 0], [0, y, 0]]), floor, (x / repeat, y / repeat)
    )
    if rng.random() < 0.3:  # another floor in a part of the room
        part, other = rng.uniform(0.25, 0.75), _surface(room, "floor")
        a, b = (part * x, y) if rng.random() < 0.5 else (x, part * y)
        corners = np.array([[0, 0, 0.002], [a, 0, 0.002], [a, b, 0.002], [0, b, 0.002]])
        build.quad(corners, other, (a / repeat, b / repeat))
    build.quad(np.array([[0, y, z], [x, y, z], [x, 0, z], [0, 0, z]]), ceiling, (x / 1.2, y / 1.2))
    corners = np.array([[0, 0], [x, 0], [x, y], [0, y]])
    wall = _surface(room, "wall")
    for side in range(4):
        a, b = corners[side], corners[(side + 1) % 4]
        layer = _surface(room, "wall") if rng.random() < 0.2 else wall
        length = float(np.linalg.norm(b - a))
        build.quad(np.array([[*b, 0], [*a, 0], [*a, z], [*b, z]]), layer, (length / 2.0, z / 2.0))
        _hang(room, a, b)


def _hang(room: Room, a: np.ndarray, b: np.ndarray) -> None:
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
        view = build.texture(("window", id(rng)), room.palette.outdoors(rng))
        high, glow = min(low + rng.uniform(0.8, 1.8), height - 0.1), rng.uniform(0.5, 5.0)
        for i in range(count):
            start = length * (i + 0.5) / count - width / 2
            panel(start - 0.06, width + 0.12, low - 0.06, high + 0.06, frame, 0.02, 0)
            panel(start, width, low, high, view, 0.025, glow)
            middle = a + along * (start + width / 2) + inward * 0.025
            room.windows.append(
                Window(
                    np.array([*middle, (low + high) / 2]),
                    np.array([*(along * width / 2), 0.0]),
                    np.array([0.0, 0.0, (high - low) / 2]),
                )
            )
            _cross(room, a + along * start, along * width, inward, low, high, frame)
        if rng.random() < 0.4:
            _curtains(room, a, along, inward, (length, width * count, high + 0.1))
        return
    if rng.random() < 0.15 and length > 2.2:
        board = build.texture(("board", int(rng.integers(1 << 30))), textures.whiteboard(rng))
        width = rng.uniform(1.2, min(2.4, length - 0.4))
        panel(rng.uniform(0.1, length - width - 0.1), width, 0.9, rng.uniform(1.8, 2.1), board,
              0.03, 0)  # fmt: skip
        return
    for _ in range(int(rng.poisson(1.2))):
        width, tall = rng.uniform(0.2, min(1.6, 0.8 * length)), rng.uniform(0.2, 1.6)
        low = rng.uniform(0.4, max(height - tall - 0.1, 0.5))
        layer = build.texture(("hung", int(rng.integers(1 << 30))), room.palette.picture(rng))
        start, off = rng.uniform(0, length - width), rng.uniform(0.01, 0.05)
        panel(start, width, low, low + tall, layer, off, rng.choice([0, 0, 0, 1.5]))


def _cross(
    room: Room, start: np.ndarray, across: np.ndarray, inward: np.ndarray,
    low: float, high: float, layer: int,
) -> None:  # fmt: skip
    """The bars of a window: one upright in the middle, perhaps one across; and a sill."""
    yaw = float(np.arctan2(across[1], across[0]))
    middle, width = start + across / 2 + inward * 0.05, float(np.linalg.norm(across))
    place = groups.spot(room, float(middle[0]), float(middle[1]), yaw)
    place.box(0, 0, low, (0.06, 0.05, high - low), layer)
    if room.rng.random() < 0.5:
        place.box(0, 0, low + (high - low) * 0.7, (width, 0.05, 0.05), layer)
    place.box(0, 0, low - 0.07, (width + 0.15, 0.1, 0.03), layer)


def _curtains(
    room: Room, a: np.ndarray, along: np.ndarray, inward: np.ndarray,
    sizes: tuple[float, float, float],
) -> None:  # fmt: skip
    """Two curtains beside the windows of a wall; sizes: wall, windows, upper edge."""
    length, windows, high = sizes
    yaw = float(np.arctan2(along[1], along[0])) + np.pi
    for side in (-1, 1):
        at = a + along * np.clip(length / 2 + side * (windows / 2 + 0.1), 0.3, length - 0.3)
        at = at + inward * 0.03
        low = float(room.rng.choice([0.03, 0.4]))
        place = groups.spot(room, float(at[0]), float(at[1]), yaw, low)
        clutter.curtain(place, float(room.rng.uniform(0.3, 0.55)), high - low)


def _partition(room: Room) -> None:
    """A wall, half-high screen or pillar that stands in the room."""
    rng, (x, y, z) = room.rng, room.size
    layer = room.builder.texture("partition", room.palette.surface(rng, textures.material))
    for _ in range(int(rng.integers(1, 3))):
        high = z if rng.random() < 0.5 else rng.uniform(1.0, 1.8)
        across = rng.random() < 0.5
        thick, long = rng.uniform(0.06, 0.4), rng.uniform(0.3, 0.55) * (x if across else y)
        size = np.array([long, thick] if across else [thick, long])
        low = rng.random(2) * (np.array([x, y]) - size)
        room.builder.box(np.array([*low, 0]), np.array([*(low + size), high]), layer)
        room.taken.append((*(low + size / 2), *(size / 2)))


def _openings(room: Room, showroom: Showroom) -> None:
    """A door or two, and windows, in the walls."""
    pieces = np.array(showroom.openings(), dtype=object)
    for piece in room.rng.permutation(pieces)[:3]:
        x, y, yaw = room.wall_spot(piece.size[0], piece.size[1])
        if piece.size[2] + piece.elevation < room.size[2]:
            room.put(piece, np.array([x, y, piece.elevation]), yaw)
            room.taken.append((x, y, 0.5, 0.5))


def _furnish(room: Room, showroom: Showroom, kind: str) -> None:
    """Single pieces of the kind's categories where there still is room."""
    rng = room.rng
    pieces = [p for c in KINDS[kind] for p in showroom.of(c)]
    small = [p for p in showroom.pieces if max(p.size) < 0.6 and not p.is_opening]
    area = float(room.size[0] * room.size[1])
    people = showroom.of("Characters")
    for _ in range(int(area * rng.uniform(0.3, 1.6)) + 3):
        piece = pieces[rng.integers(len(pieces))]
        if people and rng.random() < 0.03:
            piece = people[rng.integers(len(people))]
        if max(piece.size[:2]) < 0.25 or piece.size[2] + piece.elevation > room.size[2]:
            continue
        _stand(room, piece, small)


def _stand(room: Room, piece: Piece, small: list[Piece]) -> None:
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
    if not room.put(piece, np.array([x, y, piece.elevation]), yaw):
        return
    if piece.elevation < 0.5:
        room.taken.append((x, y, *half))
        room.interests.append(np.array([x, y, min(height * 0.9, 1.3)]))
    if TOPS.search(piece.name) and 0.3 < height < 1.5 and piece.elevation < 0.3:
        for _ in range(int(rng.poisson(2.5))):
            item = small[rng.integers(len(small))]
            local = rng.uniform(-0.4, 0.4, 2) * [width, depth]
            turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
            spot = np.array([*(np.array([x, y]) + turn @ local), height + piece.elevation])
            room.put(item, spot, yaw + rng.normal(0, 0.6))


def _boxes(room: Room, count: int) -> None:
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
            palette = room.palette
            plain = rng.random() < 0.6
            image = palette.surface(rng, textures.material) if plain else palette.picture(rng)
            layer = room.builder.texture(("box", int(rng.integers(1 << 30))), image)
            low = np.array([x - half[0], y - half[1], base])
            top = np.array([x + half[0], y + half[1], high])
            room.builder.box(low, top, layer, yaw, metres_per_repeat=float(rng.uniform(0.3, 1.2)))
            base, half, yaw = high, half * rng.uniform(0.5, 0.95), yaw + rng.normal(0, 0.3)


def _lamp(room: Room, below: np.ndarray) -> None:
    """What a ceiling light looks like: a glowing panel above its position."""
    rng = room.rng
    size = (1.2, 0.2) if rng.random() < 0.4 else (0.6, 0.6)
    glow = room.builder.texture("glow", np.full((4, 4, 3), 250, np.uint8))
    (x, y), z = below[:2], min(float(below[2]) + 0.04, float(room.size[2]) - 0.01)
    a, b = np.array(size) / 2
    corners = [[x - a, y + b, z], [x + a, y + b, z], [x + a, y - b, z], [x - a, y - b, z]]
    room.builder.quad(np.array(corners), glow, emission=float(rng.uniform(3, 9)))


def _lamps(room: Room) -> list[Light]:
    """One or two lamps under the ceiling."""
    rng, size = room.rng, room.size
    lights = []
    for _ in range(int(rng.integers(1, 3))):
        position = np.array(
            [*rng.uniform(0.2, 0.8, 2) * size[:2], size[2] - rng.uniform(0.05, 0.4)]
        )
        direction = np.array([*rng.normal(0, 0.15, 2), -1.0])
        _lamp(room, position)
        warm = np.array([1.0, rng.uniform(0.85, 1.0), rng.uniform(0.65, 1.05)])
        color, cone = warm * rng.uniform(1.5, 7.0), float(rng.uniform(120, 170))
        lights.append(Light(position, direction / np.linalg.norm(direction), color, cone))
    return lights


def _daylight(room: Room) -> list[Light]:
    """The sky's light through one window or, without one, from somewhere; perhaps the sun."""
    rng, size = room.rng, room.size
    lights = []
    if room.windows and rng.random() < 0.75:
        lights.append(_sky(rng, room.windows[rng.integers(len(room.windows))]))
    elif rng.random() < 0.3:
        side = rng.integers(4)
        edge = [(0.02, 0.5), (0.98, 0.5), (0.5, 0.02), (0.5, 0.98)][side]
        position = np.array([*np.array(edge) * size[:2], rng.uniform(1.2, 2.2)])
        aim = np.array([*rng.uniform(0.2, 0.8, 2) * size[:2], 0.2]) - position
        color = np.array([0.95, 1.0, 1.1]) * rng.uniform(3, 14)
        lights.append(
            Light(position, aim / np.linalg.norm(aim), color, float(rng.uniform(60, 140)))
        )
    if room.windows and rng.random() < 0.5:
        lights.append(_sun(rng, room.windows[rng.integers(len(room.windows))]))
    return lights


def _sky(rng: np.random.Generator, window: Window) -> Light:
    """A soft cone from the window into the room, a little downwards."""
    aim = window.inward + np.array([*rng.normal(0, 0.25, 2), -rng.uniform(0.1, 0.6)])
    color = np.array([0.92, 1.0, rng.uniform(1.0, 1.2)]) * rng.uniform(2, 12)
    position = window.centre + 0.08 * window.inward
    return Light(position, aim / np.linalg.norm(aim), color, float(rng.uniform(120, 165)))


def _sun(rng: np.random.Generator, window: Window) -> Light:
    """A patch of sunlight: a far lamp whose light comes through one window."""
    side = window.right / np.linalg.norm(window.right)
    across, height = np.radians(rng.uniform(-55, 55)), np.radians(rng.uniform(12, 55))
    level = np.cos(across) * window.inward + np.sin(across) * side
    way = np.cos(height) * level - np.array([0.0, 0.0, np.sin(height)])
    color = np.array([1.0, rng.uniform(0.85, 0.98), rng.uniform(0.65, 0.92)])
    color = color * rng.uniform(2.0, 9.0) * SUN_DISTANCE**2
    reach = np.linalg.norm(window.right + window.up)
    cone = 2 * np.degrees(np.arctan(1.1 * reach / SUN_DISTANCE))
    bars = replace(window, bars=int(rng.integers(0, 3)))
    return Light(window.centre - SUN_DISTANCE * way, way, color, float(cone), bars)
