"""Furniture that stands together: desks with chairs and screens, tables, shelves, sofas."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dyfn_worlds.rooms import clutter
from dyfn_worlds.rooms.clutter import Spot
from dyfn_worlds.rooms.furniture import Piece
from dyfn_worlds.rooms.room import Room
from dyfn_worlds.scene import textures


def spot(room: Room, x: float, y: float, yaw: float, z: float = 0.0) -> Spot:
    return Spot(room.builder, room.rng, np.array([x, y, z]), yaw)


def desks(room: Room) -> None:
    """A row of one to four desks at a wall or in the room, perhaps with a second row opposite."""
    rng = room.rng
    width, deep, high = rng.uniform(1.1, 1.8), rng.uniform(0.6, 0.9), rng.uniform(0.69, 0.78)
    row = int(rng.integers(1, 4))
    chair = _chair_model(room, office=True)
    opposite = rng.random() < 0.35
    total_deep = deep * (2 if opposite else 1) + 0.5
    for count in range(row, 0, -1):
        place = _find(room, width * count, total_deep, wall=0.0 if opposite else 0.7)
        if place is not None:
            break
    else:
        return
    look = _table_look(room)
    for index in range(count):
        offset = (index - (count - 1) / 2) * width
        for turn in (0.0, np.pi) if opposite else (0.0,):
            forward = 0.25 if not opposite else deep / 2
            base = place.moved(offset * np.cos(turn), forward * np.cos(turn), 0, turn)
            if not opposite:
                base = place.moved(offset, 0.22)
            table(base, width - 0.01, deep, high, look)
            _workplace(base, width, deep, high)
            _seat(room, base, -deep / 2 - rng.uniform(-0.05, 0.3), chair, 0.5)
            room.interests.append(base.at(0, 0, high + 0.1))


def _workplace(base: Spot, width: float, deep: float, high: float) -> None:
    rng, top = base.rng, base.moved(0, 0, high)
    if rng.random() < 0.85:
        for index in range(int(rng.choice([1, 1, 2]))):
            x = rng.normal(0, 0.1) + (index * 0.62 if width > 1.3 else 0.0)
            clutter.monitor(top.moved(x, deep * 0.22, 0, rng.normal(0, 0.15)))
        clutter.keyboard(top.moved(rng.normal(0, 0.08), -deep * 0.2, 0, rng.normal(0, 0.08)))
    scatter(top, width, deep, int(rng.poisson(5)), clutter.ON_DESKS)


def scatter(
    top: Spot, width: float, deep: float, count: int, things: Sequence[clutter.Thing]
) -> None:
    """`count` things at free places of a top of this size."""
    rng = top.rng
    used: list[tuple[float, float]] = []
    for _ in range(count * 2):
        if len(used) >= count:
            return
        x, y = rng.uniform(-0.5, 0.5, 2) * [width - 0.3, deep - 0.25]
        if all(np.hypot(x - a, y - b) > 0.22 for a, b in used):
            used.append((x, y))
            things[int(rng.integers(len(things)))](top.moved(x, y, 0, rng.normal(0, 0.4)))


def meeting_table(room: Room) -> None:
    """A table with chairs on its sides, some pushed in, some pulled out, one or two missing."""
    rng = room.rng
    width, deep = rng.uniform(1.2, 3.2), rng.uniform(0.7, 1.2)
    high = rng.uniform(0.70, 0.78)
    place = _find(room, width + 0.6, deep + 1.0, wall=0.1)
    if place is None:
        return
    table(place, width, deep, high, _table_look(room))
    scatter(place.moved(0, 0, high), width, deep, int(rng.poisson(2.5 * width)), clutter.ON_TABLES)
    chair = _chair_model(room, office=rng.random() < 0.3)
    seats = max(1, int(width / 0.65))
    for side in (0.0, np.pi):
        for index in range(seats):
            if rng.random() < 0.12:
                continue
            x = (index - (seats - 1) / 2) * width / seats
            base = place.moved(x * np.cos(side), 0, 0, side)
            _seat(room, base, -deep / 2 - rng.uniform(-0.12, 0.35), chair, 0.15)
    for x in (-0.3, 0.3):
        room.interests.append(place.at(x * width, 0, high + 0.05))


def bookcase(room: Room) -> None:
    rng = room.rng
    size = (float(rng.uniform(0.6, 2.0)), float(rng.uniform(0.26, 0.45)),
            float(rng.uniform(0.7, min(2.3, room.size[2] - 0.2))))  # fmt: skip
    place = _find(room, size[0], size[1], wall=0.95)
    if place is None:
        return
    clutter.shelves(place, size)
    if size[2] < 1.5:
        things = (clutter.carton, clutter.book_pile, clutter.bottle, clutter.mug, clutter.papers)
        scatter(place.moved(0, 0, size[2]), size[0], size[1] + 0.1, int(rng.poisson(2)), things)
        if rng.random() < 0.3:
            clutter.plant(place.moved(0, 0, size[2]), float(rng.uniform(0.25, 0.6)))
    room.interests.append(place.at(0, 0, min(size[2] * 0.7, 1.3)))


def cupboards(room: Room) -> None:
    """A run of closed cabinets with doors, high or with things on its worktop."""
    rng = room.rng
    count, width, deep = int(rng.integers(1, 6)), rng.uniform(0.4, 0.8), rng.uniform(0.38, 0.62)
    high = float(rng.choice([rng.uniform(0.7, 1.15), rng.uniform(1.7, 2.2)]))
    place = _find(room, count * width, deep, wall=0.97)
    if place is None:
        return
    wooden = textures.wood if rng.random() < 0.4 else textures.paint
    front = place.layer(room.palette.surface(rng, wooden))
    dark = float(rng.choice([1.0, 1.0, 0.06, 0.3]))
    color = np.full(3, dark, np.float32)
    metal = place.layer(np.full((4, 4, 3), 190, np.uint8))
    board = textures.wood if rng.random() < 0.5 else textures.paint
    top = place.layer(room.palette.surface(rng, board))
    for index in range(count):
        x = (index - (count - 1) / 2) * width
        place.box(x, 0.01, 0.06, (width, deep - 0.02, high - 0.09), front, color * 0.8)
        place.box(x, -deep / 2 + 0.01, 0.07, (width - 0.008, 0.02, high - 0.11), front, color)
        handle = (0.012, 0.025, min(0.3, high * 0.2))
        place.box(x + width * 0.4, -deep / 2 - 0.01, high * 0.55, handle, metal)
    place.box(0, 0, high - 0.03, (count * width + 0.02, deep + 0.02, 0.03), top)
    if high < 1.3:
        total = count * width
        scatter(
            place.moved(0, 0, high), total, deep, int(rng.poisson(3 * total)), clutter.ON_TABLES
        )
    room.interests.append(place.at(0, 0, min(high, 1.2)))


def sofa_corner(room: Room) -> None:
    """A sofa or armchair of the showroom and a low table before it."""
    rng = room.rng
    pieces = room.pieces(r"sofa|couch|armchair|futon", (0.6, 2.6))
    if not pieces:
        return
    piece = pieces[rng.integers(len(pieces))]
    width, deep, high = piece.size
    place = _find(room, width + 0.1, deep + 0.7, wall=0.8)
    if place is None:
        return
    room.put(piece, place.at(0, 0.32), place.yaw)
    room.interests.append(place.at(0, 0.3, high * 0.6))
    if width > 1.2 and rng.random() < 0.6:
        low = place.moved(rng.normal(0, 0.1), -deep / 2 - 0.1)
        top = float(rng.uniform(0.35, 0.5))
        table(low, 0.9, 0.5, top, _table_look(room))
        scatter(low.moved(0, 0, top), 0.9, 0.5, int(rng.poisson(2)), clutter.ON_TABLES)


def big_plant(room: Room) -> None:
    high = float(room.rng.uniform(0.6, min(2.2, room.size[2] - 0.3)))
    place = _find(room, 0.35 + 0.2 * high, 0.35 + 0.2 * high, wall=0.7)
    if place is not None:
        clutter.plant(place, high)
        room.interests.append(place.at(0, 0, high * 0.6))


def table(base: Spot, width: float, deep: float, high: float, look: tuple[int, int, int]) -> None:
    """A slab on legs; look: layers of top and legs, and the kind of legs."""
    top, legs, kind = look
    base.box(0, 0, high - 0.03, (width, deep, 0.03), top)
    thick = 0.05
    if kind == 0:
        for x in (-1, 1):
            for y in (-1, 1):
                base.box(x * (width / 2 - 0.06), y * (deep / 2 - 0.06), 0,
                         (thick, thick, high - 0.03), legs)  # fmt: skip
    elif kind == 1:
        for x in (-1, 1):
            base.box(x * (width / 2 - 0.12), 0, 0, (thick, deep * 0.85, 0.04), legs)
            base.box(x * (width / 2 - 0.12), 0, 0.04, (thick, 0.09, high - 0.07), legs)
    else:
        for x in (-1, 1):
            base.box(x * (width / 2 - 0.015), 0, 0, (0.03, deep - 0.02, high - 0.03), legs)
        base.box(0, deep / 2 - 0.03, high - 0.4, (width - 0.06, 0.02, 0.37), legs)


def _table_look(room: Room) -> tuple[int, int, int]:
    rng, here = room.rng, spot(room, 0, 0, 0)
    top = room.palette.surface(rng, textures.wood if rng.random() < 0.55 else textures.paint)
    legs = np.full((4, 4, 3), int(rng.choice([25, 120, 200, 240])), np.uint8)
    layer = here.layer(top)
    return layer, layer if rng.random() < 0.3 else here.layer(legs), int(rng.integers(3))


def _chair_model(room: Room, office: bool) -> Piece | None:
    chairs = room.pieces(r"^(chair|armchair|.* chair)$", (0.35, 0.72), "Office" if office else "")
    return chairs[room.rng.integers(len(chairs))] if chairs else None


def _seat(room: Room, base: Spot, y: float, chair: Piece | None, wild: float) -> None:
    """A chair that faces +y of `base`, its front at about y."""
    rng = room.rng
    turn = np.pi + rng.normal(0, wild)
    if chair is None:
        _plain_chair(base.moved(0, y - 0.1, 0, turn))
        return
    place = base.moved(rng.normal(0, 0.05), y - chair.size[1] * 0.3, 0, turn)
    room.put(chair, place.position, place.yaw, keep=True)


def _plain_chair(base: Spot) -> None:
    layer = base.builder.texture("chair", textures.cloth(base.rng))
    base.box(0, 0, 0.43, (0.43, 0.42, 0.04), layer)
    base.box(0, 0.2, 0.5, (0.42, 0.03, 0.38), layer)
    for x in (-0.19, 0.19):
        for y in (-0.18, 0.19):
            base.box(x, y, 0, (0.03, 0.03, 0.43), layer)


def _find(room: Room, width: float, deep: float, wall: float) -> Spot | None:
    """A free place of this size (then taken), at a wall with probability `wall`."""
    rng = room.rng
    for _ in range(12):
        if rng.random() < wall:
            x, y, yaw = room.wall_spot(width, deep)
        else:
            x, y = rng.random(2) * room.size[:2]
            yaw = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.05)
        c, s = abs(np.cos(yaw)), abs(np.sin(yaw))
        half = (c * width + s * deep) / 2 - 1e-3, (s * width + c * deep) / 2 - 1e-3
        if room.fits(x, y, *half):
            room.taken.append((x, y, *half))
            return spot(room, x, y, yaw)
    return None
