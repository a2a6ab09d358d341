"""A room while it is being filled: its free floor and how pieces are put into it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from dyfn_worlds.rooms.furniture import Piece, Showroom
from dyfn_worlds.scene import textures
from dyfn_worlds.scene.builder import SceneBuilder
from dyfn_worlds.scene.palette import Palette
from dyfn_worlds.scene.scene import Window


@dataclass
class Room:
    """One box of a room while it is being filled. size: (x, y, z) metres from the origin.

    taken: footprints (centre, half sizes). interests: points that people look at. windows: in the
    walls, facing inwards.
    """

    rng: np.random.Generator
    size: np.ndarray
    showroom: Showroom | None = None
    palette: Palette = field(default_factory=Palette)
    builder: SceneBuilder = field(default_factory=SceneBuilder)
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)
    interests: list[np.ndarray] = field(default_factory=list)
    windows: list[Window] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._style = int(self.rng.integers(1 << 30))

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
        off = depth / 2 + 0.07
        return [
            (along, self.size[1] - off, 0.0),
            (off, along, np.pi / 2),
            (along, off, np.pi),
            (self.size[0] - off, along, -np.pi / 2),
        ][wall]

    def pieces(self, pattern: str, widths: tuple[float, float], category: str = "") -> list[Piece]:
        """The showroom's standing pieces of a name and width, of a category if there are any."""
        if self.showroom is None:
            return []
        found = [
            p for p in self.showroom.pieces
            if re.search(pattern, p.name, re.IGNORECASE) and widths[0] <= p.size[0] <= widths[1]
            and not p.is_opening and p.elevation == 0
        ]  # fmt: skip
        return [p for p in found if p.category == category] or found

    def put(self, piece: Piece, position: np.ndarray, yaw: float, keep: bool = False) -> bool:
        """Adds a piece in changed colours; False when its model is empty.

        keep: with the same colours each time, as the chairs around a table have them.
        """
        if self.showroom is None:
            return False
        rng = np.random.default_rng(self._style + len(piece.name)) if keep else self.rng
        images = {}
        for index, part in enumerate(self.showroom.parts(piece)):
            if rng.random() < (0.06 if part.image is not None else 0.25):
                draw = (textures.cloth, textures.wood, textures.paint)[rng.integers(3)]
                images[index] = self.palette.surface(rng, draw)
        tint = np.clip(rng.lognormal(0.0, 0.35) * rng.normal(1, 0.05, 3), 0.1, 2.0)
        return self.showroom.place(self.builder, piece, position, yaw, tint, images)
