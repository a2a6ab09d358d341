"""Scene cuts, seen causally in the pictures alone, before the network looks at them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

SIZE = (48, 36)  # width, height of the small picture
GRID = (4, 4)  # blocks across and down
BLOCK = (SIZE[0] // GRID[0], SIZE[1] // GRID[1])
REACH = (30, 20)  # pixels of displacement that are searched, across and down
SLACK = 5  # size of the window within which a block may deviate from the common displacement
_TEXTURE = 3.0  # grey levels of standard deviation below which a block shows nothing
_FEWEST = 5  # blocks that must be comparable for a displacement to count
_BINS = 8  # of the histogram, along each of two chromaticities
_BLANK_PATIENCE = 10  # blank pictures before the last scene is forgotten


@dataclass(frozen=True)
class Look:
    """A picture as the detector remembers it.

    opponent: 36 x 48 x 3 float32, grey, red - green, blue - yellow. texture: 16 float32,
    standard deviation of each block of its grey.
    colours: 64 float32, chromaticity histogram, sums to 1.
    """

    opponent: np.ndarray
    texture: np.ndarray
    colours: np.ndarray

    @property
    def blank(self) -> bool:
        """Too little to see (a cover, a flash, darkness) to say anything about the scene."""
        return bool((self.texture > _TEXTURE).sum() < _FEWEST)


def look_at(image: np.ndarray) -> Look:
    """image: H x W x 3 uint8 RGB, any size."""
    step = max(1, min(image.shape[0] // (4 * SIZE[1]), image.shape[1] // (4 * SIZE[0])))
    small = cv2.resize(image[::step, ::step], SIZE, interpolation=cv2.INTER_AREA)
    red, green, blue = (small[..., i].astype(np.float32) for i in range(3))
    grey, yellow = (red + green + blue) / 3, (red + green) / 2
    blocks = grey.reshape(GRID[1], BLOCK[1], GRID[0], BLOCK[0]).transpose(0, 2, 1, 3)
    texture = blocks.reshape(GRID[0] * GRID[1], -1).std(axis=1)
    return Look(np.dstack([grey, red - green, blue - yellow]), texture, _colours(small))


def _colours(small: np.ndarray) -> np.ndarray:
    """Histogram of r and g chromaticity, each pixel weighted by its brightness."""
    rgb = small.reshape(-1, 3).astype(np.float32) + 1
    total = rgb.sum(axis=1)
    # Chromaticities of real pictures crowd around a third: the middle half gets all the bins.
    place = np.clip((rgb[:, :2] / total[:, None] - 1 / 6) * 3 * _BINS, 0, _BINS - 1).astype(int)
    index = place[:, 0] * _BINS + place[:, 1]
    counts = np.bincount(index, total, _BINS * _BINS).astype(np.float32)
    return counts / counts.sum()


def structure_difference(before: Look, now: Look) -> float:
    """0 when the blocks of the earlier picture are all found in the later one, moved together;
    about 0.6 and more when they are not.

    Every block is searched for by normalised cross-correlation, which no change of exposure
    touches; the best common displacement counts, give or take SLACK pixels a block, and of its
    blocks the better half: the others may be occluded.
    """
    surfaces = []
    for row in range(GRID[1]):
        for column in range(GRID[0]):
            if before.texture[row * GRID[0] + column] > _TEXTURE:
                surfaces.append(_surface(before.opponent, now.opponent, row, column))
    if len(surfaces) < _FEWEST:
        return math.nan
    stack = np.sort(np.stack(surfaces), axis=0)[::-1]  # -2 marks what lies outside, so it is last
    inside = (stack > -1.5).sum(axis=0)
    kept = np.maximum((np.maximum(inside, len(surfaces) // 2) + 1) // 2, 1)
    total = np.cumsum(np.maximum(stack, 0), axis=0)
    score = np.take_along_axis(total, kept[None] - 1, axis=0)[0] / kept
    return float(1 - score.max())


def _surface(before: np.ndarray, now: np.ndarray, row: int, column: int) -> np.ndarray:
    """Correlation of one block over all displacements; -2 where it would leave the picture."""
    x, y = column * BLOCK[0], row * BLOCK[1]
    template = before[y : y + BLOCK[1], x : x + BLOCK[0]]
    left, top = max(0, x - REACH[0]), max(0, y - REACH[1])
    right, bottom = min(SIZE[0], x + REACH[0] + BLOCK[0]), min(SIZE[1], y + REACH[1] + BLOCK[1])
    found = cv2.matchTemplate(now[top:bottom, left:right], template, cv2.TM_CCOEFF_NORMED)
    found = cv2.dilate(found, np.ones((SLACK, SLACK), np.uint8))
    surface = np.full((2 * REACH[1] + 1, 2 * REACH[0] + 1), -2.0, np.float32)
    first_y, first_x = top - y + REACH[1], left - x + REACH[0]
    surface[first_y : first_y + found.shape[0], first_x : first_x + found.shape[1]] = found
    return surface


def colour_difference(before: Look, now: Look) -> float:
    """0 for the same chromaticities, 1 for none in common."""
    return float(1 - np.minimum(before.colours, now.colours).sum())


@dataclass(frozen=True)
class CutState:
    """What the detector remembers: the last picture that showed something, whether the pictures
    have been alike again since the last cut, and how many blank ones came in a row."""

    look: Look | None = None
    armed: bool = True
    blank: int = 0


class SceneCutDetector:
    """Tells, picture by picture, when the camera is suddenly somewhere else.

    A cut is reported once: a difference above `threshold`, and then none until the difference
    has been below `release` times it. Blank pictures are never a cut; the next one that shows
    something is compared with the last one that did, for up to ten blank ones.
    """

    def __init__(self, threshold: float = 0.5, release: float = 0.8) -> None:
        if not 0 < threshold < 2 or not 0 < release <= 1:
            raise ValueError(f"threshold {threshold} must be in 0..2 and release {release} in 0..1")
        self.threshold, self.release = threshold, release
        self.state = CutState()
        self.difference = math.nan  # of the last two pictures; NaN: not comparable

    def push(self, image: np.ndarray) -> bool:
        """image: H x W x 3 uint8 RGB. -> whether it begins a new scene."""
        look, state = look_at(image), self.state
        self.difference = math.nan
        if look.blank:
            forget = state.blank + 1 >= _BLANK_PATIENCE
            old = None if forget else state.look
            self.state = replace(state, look=old, blank=state.blank + 1)
            return False
        if state.look is None:
            self.state = CutState(look)
            return False
        self.difference = scene_difference(state.look, look)
        cut = state.armed and self.difference > self.threshold
        armed = not cut and (state.armed or self.difference < self.release * self.threshold)
        self.state = CutState(look, armed)
        return cut

    def reset(self) -> None:
        """Forget the last picture."""
        self.state = CutState()
        self.difference = math.nan


def scene_difference(before: Look, now: Look) -> float:
    """Structure and colour together: 0 the same, about 1 when nothing is left. NaN: blank."""
    return structure_difference(before, now) + 0.5 * colour_difference(before, now)
