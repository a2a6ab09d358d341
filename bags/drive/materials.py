"""Materials of the home: own procedural textures in fixed colours."""

from __future__ import annotations

import cv2
import numpy as np

from dyfn_worlds.scene import textures
from dyfn_worlds.scene.scene import TEXTURE_SIZE as N


def _rgb(color: str) -> np.ndarray:
    """'#rrggbb' -> RGB in 0..1."""
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255


def _shaded(color: np.ndarray, height: np.ndarray, amount: float) -> np.ndarray:
    pixels = color * (1 + amount * height[..., None])
    return np.clip(255 * pixels, 0, 255).astype(np.uint8)


def paint(rng: np.random.Generator, color: str) -> np.ndarray:
    """Rolled wall paint: an even colour with a fine grain."""
    grain = cv2.GaussianBlur(rng.normal(size=(N, N)).astype(np.float32), (0, 0), 0.8)
    return _shaded(_rgb(color), grain / grain.std() * 0.5 + textures.clouds(rng, 3), 0.018)


def oak(rng: np.random.Generator, color: str, amount: float = 0.10) -> np.ndarray:
    """Wood grain along x, without joints."""
    fine = textures.clouds(rng, 6, stretch=16)
    return _shaded(_rgb(color), fine, amount)


def planks(rng: np.random.Generator, color: str, rows: int = 8) -> np.ndarray:
    """A parquet of `rows` planks along x with staggered ends."""
    grain = textures.clouds(rng, 6, stretch=16)
    high = N // rows
    out = np.zeros((N, N, 3), np.uint8)
    for row in range(rows):
        y = slice(row * high, (row + 1) * high)
        shift = int(rng.integers(N))
        cut = int(rng.uniform(0.35, 0.65) * N)
        tone = np.where((np.arange(N) + shift) % N < cut, *rng.normal(0, 0.09, 2))
        strip = np.roll(grain, int(rng.integers(N)), axis=1)[y] * 0.11 + tone[None]
        band = _rgb(color) * (1 + strip[..., None])
        ends = ((np.arange(N) + shift) % N < 1) | ((np.arange(N) + shift - cut) % N < 1)
        band[:, ends] *= 0.6
        band[0] *= 0.62
        out[y] = np.clip(255 * band, 0, 255)
    return out


def tiles(rng: np.random.Generator, color: str, joint: str, count: int = 4) -> np.ndarray:
    """Square stone tiles, count x count."""
    y, x = np.mgrid[:N, :N]
    side = N // count
    tone = rng.normal(0, 0.03, (count, count))[y // side, x // side]
    body = _shaded(_rgb(color), textures.clouds(rng, 6) * 0.05 + tone, 1.0)
    body[(y % side < 2) | (x % side < 2)] = 255 * _rgb(joint)
    return body


def cloth(rng: np.random.Generator, color: str, amount: float = 0.1) -> np.ndarray:
    """A coarse weave."""
    y, x = np.mgrid[:N, :N]
    weave = np.sin(x * 2 * np.pi * 32 / N) * np.sin(y * 2 * np.pi * 32 / N)
    grain = rng.normal(size=(N, N))
    return _shaded(_rgb(color), 0.5 * weave + textures.clouds(rng, 4) + 0.4 * grain, amount)


def rug(rng: np.random.Generator, ground: str, bands: tuple[str, ...]) -> np.ndarray:
    """A woven rug: a border of bands and a field of lozenges."""
    y, x = np.mgrid[:N, :N]
    edge = np.minimum(np.minimum(x, N - 1 - x), np.minimum(y, N - 1 - y))
    image = np.tile(_rgb(ground), (N, N, 1))
    lozenge = (np.abs((x % 64) - 32) + np.abs((y % 64) - 32)) // 8
    for index, color in enumerate(bands):
        image[lozenge == 1 + 2 * index] = _rgb(color)
        image[(edge > 8 + 10 * index) & (edge < 13 + 10 * index)] = _rgb(color)
    outside = edge < 8
    image[outside] = _rgb(bands[0]) * 0.8
    return np.clip(255 * image * (1 + 0.08 * rng.normal(size=(N, N, 1))), 0, 255).astype(np.uint8)


def leaves(rng: np.random.Generator, color: str) -> np.ndarray:
    """A hedge or a tree's crown from some way off."""
    blotches = textures.clouds(rng, 6) + 0.5 * rng.normal(size=(N, N)).astype(np.float32)
    return _shaded(_rgb(color), blotches, 0.35)


def landscape(rng: np.random.Generator, sky: str, hills: tuple[str, ...]) -> np.ndarray:
    """A picture for a wall: a sky over ridges that come nearer."""
    y = np.linspace(0, 1, N)[:, None]
    image = (_rgb(sky) * (0.85 + 0.15 * y[..., None])) * np.ones((N, N, 1))
    for index, color in enumerate(hills):
        ridge = 0.35 + 0.5 * index / len(hills) + 0.12 * textures.clouds(rng, 3)[index * 9]
        image[y[:, 0][:, None] > ridge[None]] = _rgb(color)
    return np.clip(255 * image * (1 + 0.02 * rng.normal(size=(N, N, 1))), 0, 255).astype(np.uint8)


def circles(rng: np.random.Generator, ground: str, colors: tuple[str, ...]) -> np.ndarray:
    """A picture for a wall: a few discs and bars on a plain ground."""
    image = np.tile(255 * _rgb(ground), (N, N, 1)).astype(np.uint8)
    for index, color in enumerate(colors):
        ink = tuple(float(c) for c in 255 * _rgb(color))
        centre = (int(rng.integers(50, 206)), int(rng.integers(50, 206)))
        if index % 2:
            other = (centre[0] + int(rng.integers(-90, 90)), int(rng.integers(30, 226)))
            cv2.line(image, centre, other, ink, 9, cv2.LINE_AA)
        else:
            cv2.circle(image, centre, int(rng.integers(22, 64)), ink, -1, cv2.LINE_AA)
    return image
