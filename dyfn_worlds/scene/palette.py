"""What surfaces look like: photographs where the art folder has some, own textures elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from dyfn_worlds.scene import textures
from dyfn_worlds.scene.builder import fit_texture
from dyfn_worlds.scene.scene import TEXTURE_SIZE

Draw = Callable[[np.random.Generator], np.ndarray]
SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
SMALLEST = 200
KEPT = 200  # images in memory, 2 MB each
PICTURE_FOLDERS = ("backgrounds", "wallpapers", "photos")
MATERIAL_FOLDERS = ("textures", "materials")


class Palette:
    """Photographs and photographed materials; either list may be empty.

    pool: further pictures for posters, cartons and now and then a surface. share: of the surfaces
    that are a photographed material.
    """

    def __init__(
        self,
        pool: Sequence[np.ndarray] = (),
        photographs: Sequence[Path] = (),
        materials: Sequence[Path] = (),
        share: float = 0.5,
    ) -> None:
        self.pool, self.photographs, self.materials = list(pool), list(photographs), list(materials)
        self.share = share

    @classmethod
    def find(cls, assets: Path, pool: Sequence[np.ndarray] = ()) -> Palette:
        """The images below folders named like those of Debian's wallpapers and of texture sets."""
        found: tuple[list[Path], list[Path]] = ([], [])
        for path in sorted(p for p in assets.rglob("*") if p.suffix.lower() in SUFFIXES):
            folders = {part.lower() for part in path.relative_to(assets).parts[:-1]}
            for names, paths in zip((PICTURE_FOLDERS, MATERIAL_FOLDERS), found, strict=True):
                if folders.intersection(names):
                    paths.append(path)
                    break
        return cls(pool, *found)

    def surface(self, rng: np.random.Generator, draw: Draw) -> np.ndarray:
        """A material: a photographed one in changed colours, or what `draw` makes."""
        if self.pool and rng.random() < 0.04:
            return self.pool[rng.integers(len(self.pool))]
        own = draw(rng)
        if rng.random() >= self.share:
            return own
        photo = self._any(self.materials, rng)
        return own if photo is None else _recolored(photo, own, rng)

    def picture(self, rng: np.random.Generator) -> np.ndarray:
        """Something to hang on a wall: a part of a photograph, of the pool, or own art."""
        chance = rng.random()
        if chance < 0.5 and (photo := self._any(self.photographs, rng)) is not None:
            return _part(photo, rng)
        if self.pool and chance < 0.8:
            return self.pool[rng.integers(len(self.pool))]
        return textures.picture(rng) if chance < 0.95 else textures.books(rng)

    def outdoors(self, rng: np.random.Generator) -> np.ndarray:
        """What is seen behind a window: bright, and never sharp."""
        photo = self._any(self.photographs, rng) if rng.random() < 0.6 else None
        if photo is None:
            return textures.window(rng)
        blurred = cv2.GaussianBlur(_part(photo, rng), (0, 0), float(rng.uniform(1.0, 5.0)))
        return (255 * (blurred / 255.0) ** rng.uniform(0.4, 0.9)).astype(np.uint8)

    def _any(self, paths: list[Path], rng: np.random.Generator) -> np.ndarray | None:
        """One of the images, None when there is none or when it cannot be read or is tiny."""
        if not paths:
            return None
        return _read(paths[rng.integers(len(paths))])


@lru_cache(maxsize=KEPT)
def _read(path: Path) -> np.ndarray | None:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None or min(image.shape[:2]) < SMALLEST:
        return None
    scale = 3 * TEXTURE_SIZE / min(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _part(photo: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random square of half the size and more."""
    side = int(min(photo.shape[:2]) * rng.uniform(0.5, 1.0))
    y = rng.integers(photo.shape[0] - side + 1)
    x = rng.integers(photo.shape[1] - side + 1)
    return fit_texture(photo[y : y + side, x : x + side])


def _recolored(photo: np.ndarray, own: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The photograph as it is, or its pattern in the mean colour of the other texture."""
    image = fit_texture(photo) if rng.random() < 0.7 else _mirrored(_part(photo, rng))
    if rng.random() < 0.45:
        return image
    pattern = image.astype(np.float32) / max(float(image.mean()), 8.0)
    pattern = 1 + (pattern - 1) * rng.uniform(0.3, 1.0)
    result: np.ndarray = np.clip(pattern * own.reshape(-1, 3).mean(axis=0), 0, 255).astype(np.uint8)
    return result


def _mirrored(image: np.ndarray) -> np.ndarray:
    """A part that does not tile, made to."""
    half = cv2.resize(image, (TEXTURE_SIZE // 2, TEXTURE_SIZE // 2), interpolation=cv2.INTER_AREA)
    row = np.hstack([half, half[:, ::-1]])
    return np.ascontiguousarray(np.vstack([row, row[::-1]]))
