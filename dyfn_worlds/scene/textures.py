"""Procedural materials: 256 x 256 uint8 RGB textures that tile, drawn from a seed."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from dyfn_worlds.scene.scene import TEXTURE_SIZE as N

Color = np.ndarray


def muted_color(rng: np.random.Generator) -> Color:
    """A colour as paint, cloth and wood have it: seldom saturated. RGB in 0..1."""
    hsv = np.array([[[rng.uniform(0, 360), rng.beta(1.3, 4.0), rng.uniform(0.25, 0.98)]]])
    result: Color = cv2.cvtColor(hsv.astype(np.float32), cv2.COLOR_HSV2RGB)[0, 0]
    return result


def wood_color(rng: np.random.Generator) -> Color:
    hsv = np.array([[[rng.uniform(15, 38), rng.uniform(0.25, 0.7), rng.uniform(0.3, 0.85)]]])
    result: Color = cv2.cvtColor(hsv.astype(np.float32), cv2.COLOR_HSV2RGB)[0, 0]
    return result


def neutral_color(rng: np.random.Generator) -> Color:
    """White, grey and beige as on most walls, ceilings and office furniture."""
    grey = 1 - rng.beta(1.2, 3.0) * 0.75
    return np.clip(grey * (1 + rng.normal(0, 0.02) * np.array([1.0, 0.0, -1.0])), 0, 1)


def clouds(rng: np.random.Generator, octaves: int = 5, stretch: int = 1) -> np.ndarray:
    """N x N tiling noise in about -1..1; stretch lengthens it along x."""
    out = np.zeros((N, N), np.float32)
    for octave in range(octaves):
        cells = 4 << octave
        grid = rng.normal(size=(cells, max(1, cells // stretch))).astype(np.float32)
        grid = np.pad(grid, 2, mode="wrap")
        height, width = grid.shape
        big = cv2.resize(
            grid,
            (N * width // (width - 4), N * height // (height - 4)),
            interpolation=cv2.INTER_CUBIC,
        )
        y, x = (big.shape[0] - N) // 2, (big.shape[1] - N) // 2
        out += big[y : y + N, x : x + N] / 2**octave
    return out / 2.0


def _shade(color: Color, height: np.ndarray, amount: float) -> np.ndarray:
    pixels = color * (1 + amount * height[..., None])
    return np.clip(255 * pixels, 0, 255).astype(np.uint8)


def plaster(rng: np.random.Generator) -> np.ndarray:
    grain = rng.normal(size=(N, N)).astype(np.float32)
    relief = clouds(rng) * 0.4 + grain * 0.3
    return _shade(muted_color(rng), relief, rng.uniform(0.01, 0.12))


def paint(rng: np.random.Generator) -> np.ndarray:
    """A painted wall or ceiling."""
    grain = rng.normal(size=(N, N)).astype(np.float32)
    return _shade(neutral_color(rng), clouds(rng) * 0.4 + grain * 0.3, rng.uniform(0.01, 0.05))


def cardboard(rng: np.random.Generator) -> np.ndarray:
    color = np.array([0.72, 0.56, 0.38]) * rng.uniform(0.7, 1.15)
    return _shade(np.clip(color, 0, 1), clouds(rng), rng.uniform(0.02, 0.1))


def carpet(rng: np.random.Generator) -> np.ndarray:
    grain = cv2.GaussianBlur(
        rng.normal(size=(N, N)).astype(np.float32), (0, 0), rng.uniform(0.5, 2)
    )
    grain = grain / grain.std()
    return _shade(muted_color(rng), grain + clouds(rng), rng.uniform(0.05, 0.2))


def wood(rng: np.random.Generator) -> np.ndarray:
    planks = int(rng.integers(1, 9))
    relief = clouds(rng, 6, stretch=16)
    tone = np.repeat(rng.normal(size=planks), -(-N // planks))[:N, None]
    gap = (np.arange(N) % (N // planks) < 2)[:, None] * (planks > 1)
    return _shade(wood_color(rng), relief * 0.8 + tone * 0.5 - 2.0 * gap, rng.uniform(0.1, 0.3))


def tiles(rng: np.random.Generator) -> np.ndarray:
    rows, columns = (int(2 ** rng.integers(0, 4)) for _ in range(2))
    y, x = np.mgrid[:N, :N]
    height, width = N // rows, N // columns
    row = y // height
    x = (x + (row % 2) * (width // 2) * int(rng.integers(0, 2))) % N
    joint = (y % height < 3) | (x % width < 3)
    tone = rng.normal(size=(rows, columns))[row, x // width]
    first, second = muted_color(rng), muted_color(rng)
    body = _shade(first, 0.3 * tone + 0.3 * clouds(rng), rng.uniform(0.05, 0.35))
    body[joint] = (255 * second).astype(np.uint8)
    return body


def checks(rng: np.random.Generator) -> np.ndarray:
    count = int(2 ** rng.integers(1, 5))
    y, x = np.mgrid[:N, :N] * count // N
    odd = (x + y * int(rng.integers(0, 2))) % 2 == 1
    body = np.where(odd[..., None], muted_color(rng), muted_color(rng))
    return _shade(body, clouds(rng), 0.08)


def cloth(rng: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:N, :N]
    period = 2 * np.pi * 2 ** rng.integers(3, 6) / N
    weave = np.sin(x * period) * np.sin(y * period * rng.choice([0.5, 1, 2]))
    return _shade(muted_color(rng), 0.5 * weave + clouds(rng), rng.uniform(0.05, 0.25))


def picture(rng: np.random.Generator) -> np.ndarray:
    """Something to hang on a wall, lie on a desk or be shown on a screen."""
    image = _shade(muted_color(rng), clouds(rng, 4), rng.uniform(0.1, 1.0))
    for _ in range(int(rng.integers(2, 14))):
        color = tuple(int(255 * c) for c in muted_color(rng))
        a, b = rng.integers(0, N, 2), rng.integers(0, N, 2)
        kind = rng.integers(0, 4)
        if kind == 0:
            cv2.rectangle(image, a.tolist(), b.tolist(), color, -1)
        elif kind == 1:
            cv2.circle(image, a.tolist(), int(rng.integers(5, 70)), color, -1, cv2.LINE_AA)
        elif kind == 2:
            cv2.line(image, a.tolist(), b.tolist(), color, int(rng.integers(1, 9)), cv2.LINE_AA)
        else:
            for line in range(int(rng.integers(2, 10))):
                y = int(a[1]) + 12 * line
                cv2.line(image, (int(a[0]), y), (int(a[0] + rng.integers(20, 110)), y), color, 3)
    return image


def document(rng: np.random.Generator) -> np.ndarray:
    """A printed page: lines of text, perhaps a figure."""
    image = np.full((N, N, 3), int(rng.integers(215, 256)), np.uint8)
    ink = tuple(int(x) for x in rng.integers(0, 90, 3))
    y = 18
    while y < N - 16:
        if rng.random() < 0.1:
            high = int(rng.integers(30, 80))
            color = tuple(int(255 * c) for c in muted_color(rng))
            cv2.rectangle(image, (24, y), (int(rng.integers(110, N - 24)), y + high), color, -1)
            y += high + 12
        end = int(rng.integers(60, N - 20))
        for x in range(22, end, 9):
            cv2.line(image, (x, y), (min(x + int(rng.integers(3, 8)), end), y), ink, 2)
        y += int(rng.choice([8, 8, 8, 16]))
    return image


def screen(rng: np.random.Generator) -> np.ndarray:
    """What a monitor shows: a background, windows, text."""
    image = _shade(muted_color(rng), clouds(rng, 3), rng.uniform(0.05, 0.5))
    for _ in range(int(rng.integers(1, 4))):
        x, y = (int(v) for v in rng.integers(0, 120, 2))
        w, h = (int(v) for v in rng.integers(70, 220, 2))
        light = rng.random() < 0.6
        page = document(rng) if light else 255 - document(rng)
        part = cv2.resize(page, (w, h), interpolation=cv2.INTER_AREA)
        image[y : y + h, x : x + w] = part[: N - y, : N - x]
        cv2.rectangle(image, (x, y), (x + w, y + 7), (90, 100, 120), -1)
    return image


def keys(rng: np.random.Generator) -> np.ndarray:
    """The keys of a keyboard."""
    dark = int(rng.integers(10, 70))
    base, key = (dark, dark + 30) if rng.random() < 0.6 else (150, 225)
    image = np.full((N, N, 3), base, np.uint8)
    for row in range(5):
        for column in range(14):
            x, y = int(column * N / 14), int(row * N / 5)
            cv2.rectangle(image, (x + 2, y + 5), (x + 15, y + 45), (key,) * 3, -1)
    return image


def whiteboard(rng: np.random.Generator) -> np.ndarray:
    """A board with marker strokes in a frame."""
    image = np.full((N, N, 3), int(rng.integers(225, 250)), np.uint8)
    inks = [(20, 20, 30), (20, 40, 160), (180, 30, 30), (20, 120, 50)]
    for _ in range(int(rng.integers(0, 30))):
        start = rng.integers(15, N - 40, 2)
        steps = np.cumsum(rng.normal(0, 7, (12, 2)) + np.array([6, 0]), axis=0)
        line = np.clip(start + steps, 10, N - 10).astype(np.int32)
        cv2.polylines(image, [line], False, inks[rng.integers(4)], 2, cv2.LINE_AA)
    cv2.rectangle(image, (0, 0), (N - 1, N - 1), (150, 150, 155), 8)
    return image


def books(rng: np.random.Generator) -> np.ndarray:
    image, x = np.zeros((N, N, 3), np.uint8), 0
    while x < N:
        width, top = int(rng.integers(6, 26)), int(rng.integers(0, 70))
        image[top:, x : x + width] = (255 * muted_color(rng)).astype(np.uint8)
        image[top:, x : x + 1] //= 2
        x += width
    return image


def window(rng: np.random.Generator) -> np.ndarray:
    """The bright, blurred outdoors behind a window."""
    y = np.linspace(0, 1, N)[:, None, None]
    sky, ground = (
        np.array([0.8, 0.9, 1.0]) * rng.uniform(0.8, 1),
        (0.25 * muted_color(rng) + np.array([0.26, 0.32, 0.18]) * rng.uniform(0.4, 1.5)),
    )
    horizon = rng.uniform(0.4, 0.9) + 0.15 * clouds(rng, 3)[..., None]
    share = 1 / (1 + np.exp(-(y - horizon) * 20))
    return _shade(sky * (1 - share) + ground * share, clouds(rng, 4), 0.3)


MATERIALS: tuple[Callable[[np.random.Generator], np.ndarray], ...] = (
    plaster, plaster, carpet, wood, wood, tiles, checks, cloth, cloth,
)  # fmt: skip


def material(rng: np.random.Generator) -> np.ndarray:
    """Any material at random."""
    return MATERIALS[rng.integers(len(MATERIALS))](rng)
