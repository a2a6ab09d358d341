"""Chooses what moves in a scene: figures of a game, chairs, boxes, animals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dyfn_worlds.maps import md3
from dyfn_worlds.maps.quake import GameFiles
from dyfn_worlds.rooms.furniture import Piece, Showroom
from dyfn_worlds.scene import textures
from dyfn_worlds.scene.actors import Actor
from dyfn_worlds.scene.builder import SceneBuilder, stiff_actor
from dyfn_worlds.scene.scene import Scene
from dyfn_worlds.scene.vary import tint

PROP_NAMES = ("chair", "stool", "box", "crate", "dustbin", "basket", "suitcase", "cart", "trolley",
              "puff", "stroller", "wheelbarrow", "tricycle", "scooter", "dog", "cat",
              "holding male", "plant", "trash", "ball")  # fmt: skip

# players of about a person's shape; the others are monsters, or scale their heads
PEOPLE = frozenset({"assassin", "ayumi", "beret", "major", "neko", "penguin", "sarge", "smarine",
                    "sorceress", "tony"})  # fmt: skip


class Cast:
    """What there is to choose from. files: of the game."""

    def __init__(self, files: GameFiles | None, showroom: Showroom | None) -> None:
        self.files, self.showroom = files, showroom
        self.figures: list[tuple[str, str]] = []
        people = [p for p in md3.players(files) if p.split("/")[-1] in PEOPLE] if files else []
        for player in people:
            assert files is not None
            self.figures += [(player, skin) for skin in md3.skins(files, player)]
        pieces = showroom.pieces if showroom else []
        self.props = [p for p in pieces if _is_prop(p)]

    def join(self, scene: Scene, rng: np.random.Generator) -> None:
        """Adds one to six actors, and their textures, to the scene."""
        for _ in range(int(rng.integers(0, 4)) if self.figures else 0):
            try:
                scene.actors.append(self._figure(scene, rng))
            except md3.ModelError:
                continue  # a game's player may lack a part; another one plays
        for _ in range(int(rng.integers(1, 4))):
            scene.actors.append(self._prop(scene, rng))

    def _figure(self, scene: Scene, rng: np.random.Generator) -> Actor:
        assert self.files is not None
        folder, skin = self.figures[rng.integers(len(self.figures))]

        def recolor(image: np.ndarray) -> np.ndarray:
            return tint(image, rng, 0.35)

        return md3.load_player(
            self.files, folder, skin, float(rng.uniform(1.55, 1.92)), _guest(scene),
            int(rng.integers(2)), recolor,
        )  # fmt: skip

    def _prop(self, scene: Scene, rng: np.random.Generator) -> Actor:
        if self.showroom is not None and self.props and rng.random() < 0.75:
            piece = self.props[rng.integers(len(self.props))]
            guest = _guest(scene)
            color = np.clip(rng.lognormal(0.1, 0.3) * rng.normal(1, 0.08, 3), 0.2, 2.5)
            if self.showroom.place(guest, piece, np.zeros(3), 0.0, color):
                return stiff_actor(piece.name, guest)
        return _carton(scene, rng)


def _is_prop(piece: Piece) -> bool:
    name, (width, depth, height) = piece.name.lower(), piece.size
    fits = 0.2 < max(width, depth) < 1.1 and 0.2 < height < 2.0 and piece.elevation == 0
    return fits and not piece.is_opening and any(word in name for word in PROP_NAMES)


def _guest(scene: Scene) -> SceneBuilder:
    """A builder of its own mesh that adds textures to the scene's."""
    guest = SceneBuilder()
    guest.textures = scene.textures
    return guest


def _carton(scene: Scene, rng: np.random.Generator) -> Actor:
    guest = _guest(scene)
    half = rng.uniform(0.12, 0.35, 2)
    draw: Callable[[np.random.Generator], np.ndarray] = (
        textures.picture if rng.random() < 0.3 else textures.material
    )
    layer = guest.texture("carton", draw(rng))
    high = float(rng.uniform(0.2, 1.1))
    guest.box(np.array([*-half, 0.0]), np.array([*half, high]), layer, metres_per_repeat=0.6)
    return stiff_actor("carton", guest)
