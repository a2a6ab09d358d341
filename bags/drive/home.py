"""The home of the demo: a living room, a kitchen, a hall and a study, furnished at true scale.

Metres; x to the east, y to the north, z up. Living room 5.4 x 4.3, kitchen 3.7 x 4.3, hall
9.2 x 1.4, study 4.6 x 3.5, 2.6 high; a closed bedroom behind its door.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from drive import materials
from drive.daylight import Lamp, Sky
from drive.shell import Finish, Opening, Wall, build_ceiling, build_floor, build_wall
from dyfn_worlds.rooms import clutter, groups
from dyfn_worlds.rooms.clutter import Spot
from dyfn_worlds.rooms.furniture import Piece, Showroom
from dyfn_worlds.scene import textures
from dyfn_worlds.scene.builder import SceneBuilder, new_vertices
from dyfn_worlds.scene.scene import Light, Scene, Window

HEIGHT = 2.6
OUTER, INNER = 0.3, 0.12  # thickness of walls
INSIDE = (np.array([-0.31, -0.31, -0.01]), np.array([9.51, 9.71, HEIGHT + 0.01]))
SUN_DISTANCE = 15.0
SOUTH, WEST, NORTH = (1, 0), (0, 1), (-1, 0)  # a window's way to the right, seen from indoors
WARM = np.array([1.0, 0.82, 0.6])

LIVING_WINDOW = Opening(1.35, 3.65, 0.9, 2.2)
GARDEN_DOOR = Opening(0.9, 2.5, 0.02, 2.2)
KITCHEN_WINDOW = Opening(6.7, 8.1, 1.15, 2.2)
HALL_WINDOW = Opening(4.75, 5.5, 0.95, 2.15)
STUDY_WINDOW = Opening(1.1, 3.3, 0.9, 2.2)
ARCH = Opening(2.55, 3.65, 0.0, 2.1)
KITCHEN_DOOR = Opening(7.6, 8.5, 0.0, 2.05)
STUDY_DOOR = Opening(2.2, 3.1, 0.0, 2.05)
CLOSED_DOORS = (Opening(1.0, 1.85, 0.0, 2.05), Opening(6.3, 7.15, 0.0, 2.05))
ENTRANCE = Opening(4.68, 5.58, 0.0, 2.08)


@dataclass(frozen=True)
class Home:
    """A scene without its baked light, and what lights it."""

    scene: Scene
    windows: list[Window]
    lamps: list[Lamp]
    sky: Sky


class Furnisher:
    """Puts things into one scene. seed: of the small things' colours and shapes."""

    def __init__(self, showroom: Showroom, seed: int) -> None:
        self.builder, self.showroom = SceneBuilder(), showroom
        self.seed = seed
        self.models = {piece.model.split("/")[1]: piece for piece in showroom.pieces}

    def layer(self, key: str, image: np.ndarray) -> int:
        return self.builder.texture(key, image)

    def rng(self, *key: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *key])

    def spot(self, x: float, y: float, yaw: float = 0.0, z: float = 0.0, seed: int = 0) -> Spot:
        rng = self.rng(round(100 * x) + 10_000, round(100 * y) + 10_000, seed)
        return Spot(self.builder, rng, np.array([x, y, z]), yaw)

    def put(
        self, model: str, x: float, y: float, yaw: float = 0.0, z: float = 0.0,
        tint: float | tuple[float, float, float] = 1.0,
    ) -> Piece:  # fmt: skip
        """A library's model by its folder's name; the back is towards +y at yaw 0."""
        piece = self.models[model]
        color = np.broadcast_to(np.asarray(tint, float), 3)
        if not self.showroom.place(self.builder, piece, np.array([x, y, z]), yaw, color):
            raise ValueError(f"the furniture library's model {model} is empty")
        return piece

    def cabinet(
        self, spot: Spot, size: tuple[float, float, float], doors: int, wood: int, handle: int
    ) -> None:
        """A closed cabinet with a row of doors and a top. size: width, depth, height."""
        width, deep, high = size
        spot.box(0, 0.02, 0, (width - 0.04, deep - 0.08, 0.06), handle)
        spot.box(0, 0.01, 0.06, (width, deep - 0.02, high - 0.085), wood)
        each = width / doors
        for index in range(doors):
            x = (index - (doors - 1) / 2) * each
            spot.box(x, -deep / 2, 0.075, (each - 0.006, 0.02, high - 0.115), wood)
            side = each / 2 - 0.05 if index % 2 == 0 else -(each / 2 - 0.05)
            spot.box(x + side, -deep / 2 - 0.018, high * 0.5, (0.012, 0.02, 0.12), handle)
        spot.box(0, 0, high - 0.025, (width + 0.01, deep + 0.01, 0.025), wood)

    def picture(self, spot: Spot, size: tuple[float, float], image: int, frame: int) -> None:
        """A framed picture whose back is on the wall at the spot; its lower edge at the spot."""
        width, high = size
        spot.box(0, -0.012, 0, (width, 0.024, high), frame)
        spot.panel(0, -0.026, 0.02, width - 0.04, high - 0.04, image)

    def curtain(self, spot: Spot, width: float, height: float, layer: int) -> None:
        """Folds of cloth along x that hang from `height` above the spot down to it."""
        folds = max(3, int(width / 0.13))
        x = np.linspace(-width / 2, width / 2, folds * 8 + 1)
        y = 0.035 * np.sin(np.linspace(0, folds * 2 * np.pi, len(x)))
        for a in range(len(x) - 1):
            corners = [(x[a], y[a], 0.0), (x[a + 1], y[a + 1], 0.0),
                       (x[a + 1], y[a + 1], height), (x[a], y[a], height)]  # fmt: skip
            world = np.array([spot.at(float(p), float(q), r) for p, q, r in corners])
            self.builder.quad(world, layer, (0.02, height / 0.5))


def build_home(showroom: Showroom, seed: int) -> Home:
    """The whole home, with a garden around it."""
    f = Furnisher(showroom, seed)
    trim = f.layer("trim", materials.paint(f.rng(1), "#f1efe9"))
    finish = Finish(trim, f.layer("render", materials.paint(f.rng(2), "#d8d2c4")))
    _shell(f, finish)
    _living_room(f, trim)
    _kitchen(f, trim)
    _hall(f, trim)
    _study(f, trim)
    _garden(f)
    windows = _windows()
    sun_way = np.array([0.42, 0.66, -0.62])
    sky = Sky(np.array([0.93, 1.0, 1.08]), sun_way / np.linalg.norm(sun_way),
              np.array([1.0, 0.9, 0.74]) * 1.6)  # fmt: skip
    lights = [_sunbeam(window, sky) for window in windows[:3]]
    scene = f.builder.build(
        lights=lights, sky=np.array([[0.97, 0.98, 0.99], [0.86, 0.93, 1.0]], np.float32),
        name="home",
    )  # fmt: skip
    lamps = [Lamp(np.array([x, 5.12, HEIGHT - 0.16]), 0.2 * WARM) for x in HALL_LAMPS]
    lamps.append(Lamp(np.array([2.3, 7.6, HEIGHT - 0.16]), 0.2 * WARM))
    lamps.append(Lamp(np.array([6.9, 1.75, 1.62]), 0.16 * WARM))
    return Home(scene, windows, lamps, sky)


HALL_LAMPS = (1.6, 4.4, 7.4)


def _windows() -> list[Window]:
    def window(hole: Opening, way: tuple[int, int], across: float) -> Window:
        along, high = (hole.low + hole.high) / 2, (hole.top - hole.sill) / 2
        centre = (along, across) if way[0] else (across, along)
        half = (hole.high - hole.low) / 2
        # the renderer's windows face the way of up x right
        right = np.array([way[0] * half, -way[1] * half, 0.0])
        return Window(
            np.array([*centre, (hole.sill + hole.top) / 2]), right, np.array([0, 0, high])
        )

    return [
        window(LIVING_WINDOW, SOUTH, -OUTER),
        window(KITCHEN_WINDOW, SOUTH, -OUTER),
        window(GARDEN_DOOR, WEST, -OUTER),
        window(HALL_WINDOW, WEST, -OUTER),
        window(STUDY_WINDOW, NORTH, 9.4 + OUTER),
    ]


def _sunbeam(window: Window, sky: Sky) -> Light:
    reach = float(np.linalg.norm(window.right + window.up))
    cone = 2 * float(np.degrees(np.arctan(1.6 * reach / SUN_DISTANCE)))
    position = window.centre - SUN_DISTANCE * sky.sun_way
    return Light(position, sky.sun_way, sky.sun * (SUN_DISTANCE**2 + 0.5), cone + 20, window)


def _shell(f: Furnisher, finish: Finish) -> None:
    living = f.layer("living wall", materials.paint(f.rng(3), "#e6e0d2"))
    accent = f.layer("accent wall", materials.paint(f.rng(4), "#8fa39b"))
    kitchen = f.layer("kitchen wall", materials.paint(f.rng(5), "#ece7da"))
    hall = f.layer("hall wall", materials.paint(f.rng(6), "#dfd8c8"))
    study = f.layer("study wall", materials.paint(f.rng(7), "#dcdfe0"))
    blue = f.layer("blue wall", materials.paint(f.rng(8), "#7d93a8"))
    out = -1
    walls = [
        Wall(0, -OUTER, 0, -OUTER, 5.46, (out, living), (LIVING_WINDOW,)),
        Wall(0, -OUTER, 0, 5.46, 9.5, (out, kitchen), (KITCHEN_WINDOW,)),
        Wall(1, -OUTER, 0, -OUTER, 4.36, (out, living), (GARDEN_DOOR,)),
        Wall(1, -OUTER, 0, 4.36, 5.88, (out, hall), (HALL_WINDOW,)),
        Wall(1, -OUTER, 0, 5.88, 9.7, (out, study)),
        Wall(0, 9.4, 9.7, -OUTER, 4.66, (study, out), (STUDY_WINDOW,)),
        Wall(0, 9.4, 9.7, 4.66, 9.5, (study, out)),
        Wall(1, 9.2, 9.5, -OUTER, 4.36, (kitchen, out)),
        Wall(1, 9.2, 9.5, 4.36, 5.88, (hall, out), (ENTRANCE,)),
        Wall(1, 9.2, 9.5, 5.88, 9.7, (study, out)),
        Wall(1, 5.4, 5.52, 0, 4.36, (accent, kitchen), (ARCH,)),
        Wall(0, 4.3, 4.42, 0, 5.46, (living, hall), CLOSED_DOORS[:1]),
        Wall(0, 4.3, 4.42, 5.46, 9.2, (kitchen, hall), (KITCHEN_DOOR,)),
        Wall(0, 5.82, 5.94, 0, 4.66, (hall, study), (STUDY_DOOR,)),
        Wall(0, 5.82, 5.94, 4.66, 9.2, (hall, study), CLOSED_DOORS[1:]),
        Wall(1, 4.6, 4.72, 5.88, 9.4, (blue, study)),
    ]
    for wall in walls:
        build_wall(f.builder, wall, HEIGHT, finish)
    _door_leaf(f, CLOSED_DOORS[0], 0, 4.36, finish.trim)
    _door_leaf(f, CLOSED_DOORS[1], 0, 5.88, finish.trim)
    _door_leaf(f, ENTRANCE, 1, 9.32, f.layer("entrance", materials.oak(f.rng(9), "#5d4630")))
    parquet = f.layer("parquet", materials.planks(f.rng(10), "#a9794c"))
    grey = f.layer("grey oak", materials.planks(f.rng(11), "#9c8569"))
    stone = f.layer("stone", materials.tiles(f.rng(12), "#b9b0a2", "#8d867b"))
    build_floor(f.builder, (0, 0), (5.46, 4.36), parquet, 1.6)
    build_floor(f.builder, (5.46, 0), (9.2, 4.36), stone, 1.6)
    build_floor(f.builder, (0, 4.36), (9.2, 5.88), parquet, 1.6)
    build_floor(f.builder, (0, 5.88), (4.66, 9.4), grey, 1.6)
    white = f.layer("ceiling", materials.paint(f.rng(13), "#f4f3f0"))
    build_ceiling(f.builder, (0, 0), (5.46, 4.36), white, HEIGHT)
    build_ceiling(f.builder, (5.46, 0), (9.2, 4.36), white, HEIGHT)
    build_ceiling(f.builder, (0, 4.36), (9.2, 5.88), white, HEIGHT)
    build_ceiling(f.builder, (0, 5.88), (4.66, 9.4), white, HEIGHT)
    build_floor(f.builder, (-0.6, -0.6), (9.8, 10.0), finish.outdoors, 4.0, HEIGHT + 0.25)
    steel = f.layer("steel", np.full((4, 4, 3), 150, np.uint8))
    for low, high in (((5.42, 2.55), (5.5, 3.65)), ((7.6, 4.32), (8.5, 4.4))):
        f.builder.box(np.array([*low, 0]), np.array([*high, 0.006]), steel)


def _door_leaf(f: Furnisher, hole: Opening, axis: int, across: float, layer: int) -> None:
    """A closed door with two panels and handles on both sides."""
    width, middle = hole.high - hole.low - 0.03, (hole.low + hole.high) / 2
    x, y = (middle, across) if axis == 0 else (across, middle)
    _leaf(f, f.spot(x, y, 0.0 if axis == 0 else np.pi / 2), width, hole.top - 0.015, layer)


def _leaf(f: Furnisher, spot: Spot, width: float, high: float, layer: int) -> None:
    metal = f.layer("metal", np.full((4, 4, 3), 175, np.uint8))
    spot.box(0, 0, 0.008, (width, 0.04, high - 0.008), layer)
    for low, tall in ((0.2, 0.7), (1.05, 0.8)):
        for x in (-width / 4 + 0.02, width / 4 - 0.02):
            spot.box(x, 0, low, (width / 2 - 0.16, 0.054, tall), layer)
    for side in (-1, 1):
        spot.box(width / 2 - 0.06, side * 0.045, 1.02, (0.02, 0.05, 0.02), metal)
        spot.box(width / 2 - 0.12, side * 0.065, 1.02, (0.13, 0.018, 0.02), metal)


def _living_room(f: Furnisher, trim: int) -> None:
    walnut = f.layer("walnut", materials.oak(f.rng(20), "#6b4a31"))
    black = f.layer("black", np.full((4, 4, 3), 28, np.uint8))
    pattern = materials.rug(f.rng(21), "#b7a78c", ("#7c3f35", "#3e5560", "#d9cdb4"))
    rug = f.layer("living rug", pattern)
    f.spot(2.5, 1.75).box(
        0, 0, 0, (2.7, 1.9, 0.008), f.layer("rug edge", np.full((4, 4, 3), 120, np.uint8))
    )
    f.spot(2.5, 1.75).sheet(0, 0, 0.0095, (2.7, 1.9), rug)
    f.put("sofa2", 2.5, 0.5, np.pi, tint=(0.8, 0.86, 0.9))
    f.put("armchair2", 4.2, 1.55, -np.pi / 2 - 0.2, tint=(0.95, 0.8, 0.62))
    f.put("bedsideTable2", 1.22, 0.42, np.pi)
    f.put("desklamp", 1.22, 0.42, 0.4, 0.454)
    table = f.spot(2.45, 1.72)
    groups.table(table, 1.1, 0.6, 0.42, (walnut, black, 0))
    top = f.spot(2.45, 1.72, 0.1, 0.42)
    clutter.book_pile(top.moved(-0.3, 0.05))
    clutter.mug(top.moved(0.05, -0.12))
    clutter.papers(top.moved(0.3, 0.08, 0, 0.3))
    board = f.spot(3.0, 4.07)
    f.cabinet(board, (1.8, 0.4, 0.48), 4, walnut, black)
    _television(f, f.spot(3.0, 4.1, 0, 0.48), black)
    for x in (1.97, 4.03):
        f.spot(x, 4.1).box(0, 0, 0, (0.2, 0.24, 0.6), black)
    clutter.shelves(f.spot(4.75, 4.13, 0, 0, 3), (1.2, 0.32, 2.05))
    f.put("shelves", 5.19, 1.7, -np.pi / 2)
    f.put("littlePlant", 5.2, 1.5, 0, 0.79)
    clutter.book_pile(f.spot(5.2, 1.85, -1.4, 0.79, 2))
    clutter.plant(f.spot(4.95, 0.45, 0, 0, 1), 1.7)
    clutter.plant(f.spot(0.42, 3.9, 0, 0, 2), 1.5)
    hills = materials.landscape(f.rng(22), "#e9cfa6", ("#9aa5a8", "#6f8288", "#45606a", "#2b4149"))
    f.picture(f.spot(5.4, 1.2, -np.pi / 2, 1.3), (0.9, 0.65), f.layer("hills", hills), black)
    discs = materials.circles(f.rng(23), "#e8e2d4", ("#c4563c", "#2f4858", "#e0a63c", "#2f4858"))
    f.picture(f.spot(0.0, 3.2, np.pi / 2, 1.25), (0.5, 0.7), f.layer("discs", discs), black)
    linen = f.layer("linen", materials.cloth(f.rng(24), "#cfc5ae", 0.05))
    for x in (1.15, 3.85):
        f.curtain(f.spot(x, 0.1), 0.5, 2.35, linen)
    for y in (0.65, 2.75):
        f.curtain(f.spot(0.1, y, np.pi / 2), 0.45, 2.4, linen)
    rail = f.layer("rail", np.full((4, 4, 3), 90, np.uint8))
    f.spot(2.5, 0.1, 0, 2.36).box(0, 0, 0, (3.3, 0.025, 0.025), rail)
    f.spot(0.1, 1.7, np.pi / 2, 2.41).box(0, 0, 0, (2.7, 0.025, 0.025), rail)
    _ceiling_lamp(f, 2.7, 2.2, False)


def _television(f: Furnisher, spot: Spot, black: int) -> None:
    screen = f.layer("dark screen", np.full((4, 4, 3), 22, np.uint8))
    spot.box(0, 0, 0, (0.5, 0.2, 0.015), black)
    spot.box(0, 0.02, 0.01, (0.08, 0.03, 0.08), black)
    spot.box(0, 0.01, 0.07, (1.24, 0.045, 0.72), black)
    spot.panel(0, -0.014, 0.085, 1.21, 0.69, screen)


def _ceiling_lamp(f: Furnisher, x: float, y: float, on: bool) -> None:
    """A flat round lamp under the ceiling."""
    spot = f.spot(x, y, 0, HEIGHT - 0.09)
    spot.cylinder((0.19, 0.2), 0.09, np.full(3, 0.85), 24)
    if on:
        glow = f.layer("glow", np.full((4, 4, 3), 250, np.uint8))
        turn = np.arange(24) * 2 * np.pi / 24
        for a, b in zip(turn, np.roll(turn, -1), strict=True):
            ring = [spot.at(0.18 * np.cos(t), 0.18 * np.sin(t), -0.002) for t in (b, a)]
            middle = spot.at(0, 0, -0.002)
            f.builder.quad(np.array([middle, *ring, middle]), glow, emission=2.5)


def _kitchen(f: Furnisher, trim: int) -> None:
    front, side = np.pi, -np.pi / 2  # with the back to the south, to the east
    f.put("largeFridge", 6.05, 0.43, front)
    for model, x in (("lowerCabinet", 6.86), ("sinkCabinet", 7.46), ("drawersCabinet", 8.06)):
        f.put(model, x, 0.32, front)
    f.put("lowerCornerCabinet", 8.785, 0.415, side)
    for model, y in (("lowerCabinet", 1.13), ("drawersCabinet", 1.73)):
        f.put(model, 8.885, y, side)
    f.put("stove", 8.88, 1.13, 0.0, 0.885)
    f.put("rangeHood", 9.035, 1.13, side, 1.6)
    f.put("upperCabinet", 8.99, 1.73, side, 1.45)
    f.put("glassDoorCabinet", 8.45, 0.215, front, 1.45)
    f.put("bread", 8.85, 1.8, 0.5, 0.885)
    f.put("tetrapak", 8.25, 0.4, 0.3, 0.885)
    clutter.bottle(f.spot(8.6, 0.3, 0, 0.885))
    f.put("oakTable", 6.9, 1.75)
    for x, y, yaw in ((6.1, 1.7, -np.pi / 2 - 0.1), (7.72, 1.8, np.pi / 2), (6.8, 2.42, np.pi)):
        f.put("osakaChair", x, y, yaw)
    f.put("caffe_final", 6.7, 2.0, 0.4, 0.741)
    f.put("plasticCup", 7.15, 1.55, 0, 0.741)
    clutter.papers(f.spot(7.05, 1.95, 0.5, 0.741, 1))
    f.put("littlePlant", 6.85, 1.72, 0, 0.741)
    _dresser(f, f.spot(8.99, 3.2, side))
    f.put("verticalShelves", 5.8, 4.1)
    f.put("dustbin", 6.25, 4.12)
    black = f.layer("black", np.full((4, 4, 3), 28, np.uint8))
    fruit = materials.circles(
        f.rng(30), "#f0ead8", ("#d98c2b", "#5e7d3a", "#b23a2e", "#5e7d3a", "#d9b23c")
    )
    f.picture(f.spot(6.9, 4.3, 0, 1.25), (0.8, 0.55), f.layer("fruit", fruit), trim)
    discs = materials.landscape(f.rng(31), "#cfe0e6", ("#a9b89a", "#7f9a6c", "#4f6e4a"))
    f.picture(f.spot(5.52, 1.75, np.pi / 2, 1.3), (0.5, 0.7), f.layer("meadow", discs), black)
    tiles = f.layer("backsplash", materials.tiles(f.rng(32), "#dfe3e0", "#b9bdb9", 8))
    f.builder.box(np.array([6.52, 0.0, 0.885]), np.array([9.2, 0.012, 1.12]), tiles, 0, None, 1.2)
    f.builder.box(np.array([9.188, 0.0, 0.885]), np.array([9.2, 2.03, 1.45]), tiles, 0, None, 1.2)
    lamp = f.spot(6.9, 1.75, 0, 1.68)
    lamp.cylinder((0.2, 0.05), 0.2, np.array([0.12, 0.22, 0.24]), 24)
    f.spot(6.9, 1.75, 0, 1.88).box(0, 0, 0, (0.012, 0.012, HEIGHT - 1.88), black)


def _dresser(f: Furnisher, spot: Spot) -> None:
    """Two doors below, open shelves above, and what has been put down in between."""
    oak = f.layer("dresser oak", materials.oak(f.rng(33), "#b58a58"))
    brass = f.layer("brass", np.full((4, 4, 3), 70, np.uint8))
    f.cabinet(spot, (1.2, 0.42, 0.86), 3, oak, brass)
    top = spot.moved(0, 0, 0.86)
    for x in (-0.58, 0.58):
        top.box(x, 0.09, 0, (0.022, 0.24, 1.0), oak)
    top.box(0, 0.2, 0, (1.18, 0.012, 1.0), oak)
    for z in (0.42, 0.71, 0.98):
        top.box(0, 0.09, z, (1.18, 0.24, 0.02), oak)
    clutter.binders(top.moved(-0.55, 0.07, 0.44), 0.55, 0.24, 0.17)
    for x in (0.12, 0.24, 0.36, 0.47):
        clutter.mug(top.moved(x, 0.06, 0.44))
    for x in (-0.45, -0.2, 0.1, 0.4):
        clutter.bottle(top.moved(x, 0.1, 0.73))
    clutter.carton(top.moved(-0.35, -0.02))
    clutter.book_pile(top.moved(0.1, -0.03))
    clutter.plant(top.moved(0.42, -0.03), 0.3)


def _hall(f: Furnisher, trim: int) -> None:
    black = f.layer("black", np.full((4, 4, 3), 28, np.uint8))
    oak = f.layer("light oak", materials.oak(f.rng(40), "#c39a68"))
    runner = f.layer("runner", materials.rug(f.rng(41), "#6d2f2c", ("#c9a86a", "#2d3b46")))
    edge = f.layer("rug edge", np.full((4, 4, 3), 120, np.uint8))
    for x in (3.6, 5.4):
        f.spot(x, 5.12).box(0, 0, 0, (1.8, 0.75, 0.006), edge)
        f.spot(x, 5.12).sheet(0, 0, 0.0075, (1.8, 0.75), runner)
    f.cabinet(f.spot(4.5, 4.585, np.pi), (1.1, 0.3, 0.85), 3, oak, black)
    clutter.book_pile(f.spot(4.2, 4.58, np.pi + 0.3, 0.85, 2))
    clutter.plant(f.spot(4.85, 4.58, 0, 0.85, 1), 0.42)
    silver = f.layer("mirror", np.full((4, 4, 3), 205, np.uint8))
    f.picture(f.spot(4.5, 4.42, np.pi, 1.15), (0.6, 0.9), silver, oak)
    f.put("slippers", 5.35, 4.56, np.pi)
    colors = (
        ("#dfe6e4", ("#8fb0a9", "#5a857c", "#2f574f")),
        ("#f0dcc0", ("#d8a27a", "#a9674a", "#6b3c33")),
        ("#d6dbe8", ("#a3acc8", "#6a76a0", "#3c4570")),
    )  # fmt: skip
    for index, (sky, hills) in enumerate(colors):
        image = materials.landscape(f.rng(42, index), sky, hills)
        place = f.spot(3.55 + 0.55 * index, 5.82, 0, 1.3)
        f.picture(place, (0.42, 0.55), f.layer(f"row {index}", image), black)
    image = materials.circles(f.rng(45), "#e9e4da", ("#31465a", "#c9692f", "#9fb3b8", "#31465a"))
    f.picture(f.spot(5.7, 5.82, 0, 1.2), (0.7, 0.9), f.layer("abstract", image), oak)
    image = materials.landscape(f.rng(46), "#f3e3cf", ("#c7b299", "#93806b", "#5d5145"))
    f.picture(f.spot(6.6, 4.42, np.pi, 1.25), (0.6, 0.8), f.layer("sepia", image), black)
    image = materials.circles(f.rng(47), "#28323c", ("#d9c38a", "#8aa7b0", "#d9c38a"))
    f.picture(f.spot(2.8, 4.42, np.pi, 1.25), (0.6, 0.6), f.layer("night", image), trim)
    image = materials.landscape(f.rng(48), "#e2ebe6", ("#b9cdbf", "#86a794", "#557c6b", "#33544a"))
    f.picture(f.spot(8.05, 5.82, 0, 1.05), (1.0, 0.7), f.layer("forest", image), oak)
    f.put("pianoBench", 8.05, 5.62)
    clutter.plant(f.spot(0.4, 5.45, 0, 0, 3), 1.1)
    clutter.shelves(f.spot(0.9, 4.57, np.pi, 0, 4), (0.8, 0.28, 0.9))
    _leaf(f, f.spot(3.08, 6.37, np.pi / 2), 0.86, 2.03, trim)
    for x in HALL_LAMPS:
        _ceiling_lamp(f, x, 5.12, True)


def _study(f: Furnisher, trim: int) -> None:
    black = f.layer("black", np.full((4, 4, 3), 28, np.uint8))
    wool = f.layer("wool", materials.rug(f.rng(50), "#5b6b72", ("#c9c2b0", "#39474e")))
    edge = f.layer("rug edge", np.full((4, 4, 3), 120, np.uint8))
    f.spot(2.3, 7.55).box(0, 0, 0, (2.0, 1.4, 0.008), edge)
    f.spot(2.3, 7.55).sheet(0, 0, 0.0095, (2.0, 1.4), wool)
    f.put("lbDesk", 2.2, 8.92, 0.0, tint=1.6)
    top = f.spot(2.2, 8.92, 0, 0.723, 1)
    clutter.monitor(top.moved(-0.2, 0.16))
    clutter.keyboard(top.moved(-0.2, -0.18))
    clutter.papers(top.moved(0.5, -0.1, 0, 0.2))
    clutter.mug(top.moved(0.24, -0.2))
    f.put("desklamp", 2.85, 9.08, 0.3, 0.723)
    f.put("designChair", 2.05, 8.2, np.pi - 0.35)
    clutter.shelves(f.spot(0.2, 7.75, np.pi / 2, 0, 7), (2.0, 0.34, 2.1))
    f.put("desk", 4.6 - 0.29, 7.7, -np.pi / 2)
    f.put("thonet", 3.78, 7.6, np.pi / 2 - 0.2)
    f.put("bedsideTable2", 4.3, 6.35, -np.pi / 2)
    clutter.book_pile(f.spot(4.3, 6.35, -np.pi / 2, 0.454, 4))
    clutter.plant(f.spot(0.5, 9.0, 0, 0, 5), 1.6)
    f.put("dustbin", 3.2, 9.1)
    clutter.carton(f.spot(0.45, 6.3, 0.2, 0, 1))
    f.put("whiteBoard", 4.05, 8.95, -0.7)
    image = materials.landscape(f.rng(51), "#f2e6d8", ("#e0b48c", "#b57a5a", "#7a4a3f", "#3d2a2c"))
    f.picture(f.spot(4.6, 6.9, -np.pi / 2, 1.3), (0.8, 0.6), f.layer("canyon", image), black)
    image = textures.document(f.rng(52))
    f.picture(f.spot(0.0, 6.45, np.pi / 2, 1.2), (0.42, 0.6), f.layer("print", image), trim)
    _ceiling_lamp(f, 2.3, 7.6, True)


def _garden(f: Furnisher) -> None:
    """A lawn, a hedge around it and a few trees: what the windows show, overexposed."""
    grass = f.layer("grass", materials.leaves(f.rng(60), "#a9bd86"))
    hedge = f.layer("hedge", materials.leaves(f.rng(61), "#7e9a68"))
    bark = f.layer("bark", materials.oak(f.rng(62), "#7a6a5a", 0.3))
    build_floor(f.builder, (-30, -30), (40, 40), grass, 3.0, -0.08)
    (west, south), (east, north) = (-9.0, -8.0), (17.0, 17.5)
    for low, high in (
        ((west, south - 0.6), (east, south)), ((west, north), (east, north + 0.6)),
        ((west - 0.6, south), (west, north)), ((east, south), (east + 0.6, north)),
    ):  # fmt: skip
        f.builder.box(np.array([*low, -0.08]), np.array([*high, 1.6]), hedge, metres_per_repeat=1.5)
    for x, y, tall in ((-6.5, 3.0, 4.5), (0.4, -6.0, 4.2), (4.6, -7.0, 5.0), (9.3, -6.2, 4.4),
                       (0.3, 15.5, 5.2), (4.3, 16.0, 4.4), (-7.2, -3.0, 4.0)):  # fmt: skip
        f.spot(x, y, 0, -0.08).box(0, 0, 0, (0.18, 0.18, tall * 0.5), bark)
        rng = f.rng(63, round(10 * tall))
        for _ in range(14):
            out = rng.normal(0, 0.16 * tall, 3) * [1, 1, 0.8]
            centre = np.array([x, y, 0.68 * tall]) + out
            _crown(f, rng, centre, float(rng.uniform(0.09, 0.16) * tall), hedge)


def _crown(
    f: Furnisher, rng: np.random.Generator, centre: np.ndarray, radius: float, layer: int
) -> None:
    """A ragged ball of leaves."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    points = np.asarray(ball.vertices) * rng.uniform(0.75, 1.2, (len(ball.vertices), 1))
    vertices = new_vertices(len(points))
    vertices["position"] = points + centre
    vertices["normal"] = np.asarray(ball.vertices) / radius
    vertices["uv"] = points[:, :2] + points[:, 2:] * [0.5, 1.0]
    vertices["texture"] = layer
    f.builder.add(vertices, np.asarray(ball.faces))
