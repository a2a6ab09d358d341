"""Scene cuts, seen causally in the pictures alone, before the network looks at them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

SIZE = (32, 24)  # width, height of the small picture
GRID = (4, 4)  # blocks across and down
BLOCK = (SIZE[0] // GRID[0], SIZE[1] // GRID[1])
REACH = (20, 14)  # pixels of displacement that are searched, across and down
SLACK = 3  # size of the window within which a block may deviate from the common displacement
THRESHOLD = 0.6  # where a false alarm weighs as much as three misses: benchmarks/scene_cuts.py
_TEXTURE = 3.0  # grey levels of standard deviation below which a block shows nothing
_FEWEST = 5  # blocks that must be comparable for a displacement to count
_BINS = 8  # of the histogram, along each of two chromaticities
_ADJACENT, _UNRELATED = 0.3, 0.55  # seconds, see leniency
_LENIENT = 0.75
_USUAL_TURN, _USUAL_SPEED = math.radians(50), 1.0  # per second, of a walking person's camera
_BLANK_PATIENCE = 10  # blank pictures before the last scene is forgotten


@dataclass(frozen=True)
class PictureFeatures:
    """A picture as the detector remembers it.

    opponent: 24 x 32 x 3 float32, grey, red - green, blue - yellow. texture: 16 float32,
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


def picture_features(image: np.ndarray) -> PictureFeatures:
    """image: H x W x 3 uint8 RGB, any size."""
    step = max(1, min(image.shape[0] // (4 * SIZE[1]), image.shape[1] // (4 * SIZE[0])))
    small = cv2.resize(image[::step, ::step], SIZE, interpolation=cv2.INTER_AREA)
    red, green, blue = (small[..., i].astype(np.float32) for i in range(3))
    grey, yellow = (red + green + blue) / 3, (red + green) / 2
    blocks = grey.reshape(GRID[1], BLOCK[1], GRID[0], BLOCK[0]).transpose(0, 2, 1, 3)
    texture = blocks.reshape(GRID[0] * GRID[1], -1).std(axis=1)
    return PictureFeatures(np.dstack([grey, red - green, blue - yellow]), texture, _colours(small))


def _colours(small: np.ndarray) -> np.ndarray:
    """Histogram of r and g chromaticity, each pixel weighted by its brightness."""
    rgb = small.reshape(-1, 3).astype(np.float32) + 1
    total = rgb.sum(axis=1)
    # Chromaticities of real pictures crowd around a third: the middle half gets all the bins.
    place = np.clip((rgb[:, :2] / total[:, None] - 1 / 6) * 3 * _BINS, 0, _BINS - 1).astype(int)
    index = place[:, 0] * _BINS + place[:, 1]
    counts: np.ndarray = np.bincount(index, total, _BINS * _BINS).astype(np.float32)
    shares: np.ndarray = counts / counts.sum()
    return shares


def structure_difference(before: PictureFeatures, now: PictureFeatures) -> float:
    """0 when the blocks of the earlier picture are all found in the later one, moved together;
    about 0.6 and more when they are not.

    Every block is searched for by normalised cross-correlation, which no change of exposure
    touches; the best common displacement counts, give or take SLACK pixels a block, and of its
    blocks the better half: the others may be occluded.
    """
    shown = before.texture > _TEXTURE
    if shown.sum() < _FEWEST:
        return math.nan
    blocks = _windows(before.opponent, BLOCK).reshape(len(shown), -1)[shown]
    windows = _windows(now.opponent)
    found = (windows.reshape(-1, windows.shape[-1]) @ blocks.T).reshape(*windows.shape[:2], -1)
    found = cv2.dilate(found, np.ones((SLACK, SLACK), np.uint8)).reshape(found.shape)
    # Of each displacement, the blocks sorted by correlation; those that it moves out come last.
    rows, columns, inside = _DISPLACED
    stack = np.where(
        inside[..., shown], found[rows[..., shown], columns[..., shown], np.arange(shown.sum())], -2
    )
    stack = np.sort(stack, axis=-1)[..., ::-1]
    compared = np.maximum(inside[..., shown].sum(axis=-1), shown.sum() // 2)
    better = np.maximum((compared + 1) // 2, 1)
    total = np.cumsum(np.maximum(stack, 0), axis=-1)
    score = np.take_along_axis(total, better[..., None] - 1, axis=-1)[..., 0] / better
    return float(1 - score.max())


def _windows(picture: np.ndarray, step: tuple[int, int] = (1, 1)) -> np.ndarray:
    """Block-sized windows, `step` apart across and down, without their mean colour and of unit
    length: y x x x values."""
    views = np.lib.stride_tricks.sliding_window_view(picture, (BLOCK[1], BLOCK[0]), axis=(0, 1))
    views = views[:: step[1], :: step[0]]
    flat = views.reshape(*views.shape[:3], -1)
    flat = flat - flat.mean(axis=-1, keepdims=True)
    flat = flat.reshape(*flat.shape[:2], -1)
    unit: np.ndarray = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-3)
    return unit


def _displaced() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each displacement (down, across) and block: where it then is, and whether in view."""
    # Every other displacement: SLACK covers those between.
    down, across = np.mgrid[-REACH[1] : REACH[1] + 1 : 2, -REACH[0] : REACH[0] + 1 : 2]
    top, left = np.mgrid[: SIZE[1] : BLOCK[1], : SIZE[0] : BLOCK[0]]
    rows, columns = down[..., None] + top.reshape(-1), across[..., None] + left.reshape(-1)
    last = (SIZE[1] - BLOCK[1], SIZE[0] - BLOCK[0])
    inside = (rows >= 0) & (rows <= last[0]) & (columns >= 0) & (columns <= last[1])
    return rows.clip(0, last[0]), columns.clip(0, last[1]), inside


_DISPLACED = _displaced()


def colour_difference(before: PictureFeatures, now: PictureFeatures) -> float:
    """0 for the same chromaticities, 1 for none in common."""
    return float(1 - np.minimum(before.colours, now.colours).sum())


@dataclass(frozen=True)
class CutState:
    """What the detector remembers: the last picture that showed something, whether the pictures
    have been alike again since the last cut, how many blank ones came in a row, and that picture's
    stamp and pose (4 x 4, camera to world), where known."""

    look: PictureFeatures | None = None
    armed: bool = True
    blank: int = 0
    stamp: float | None = None
    pose: np.ndarray | None = None


def leniency(seconds: float) -> float:
    """What a threshold is multiplied with when so much time lies between the two pictures.

    A camera that moves shows something else after a while: 1 up to 0.3 s, growing evenly to 1.75
    at 0.55 s, where only pictures that have nothing in common are another scene
    (benchmarks/scene_cuts.py --apart).
    """
    share = (seconds - _ADJACENT) / (_UNRELATED - _ADJACENT)
    return 1 + _LENIENT * min(max(share, 0.0), 1.0)


def moving_seconds(passed: float, before: np.ndarray | None, now: np.ndarray | None) -> float:
    """The time in which a walking person's camera would have moved so far, at most what passed.

    passed: seconds. before, now: poses, 4 x 4, camera to world in metres; None where unknown.
    """
    if before is None or now is None:
        return max(passed, 0.0)
    cosine = (float(np.trace(before[:3, :3].T @ now[:3, :3])) - 1) / 2
    angle = math.acos(min(max(cosine, -1.0), 1.0))
    distance = float(np.linalg.norm(now[:3, 3] - before[:3, 3]))
    return min(max(passed, 0.0), max(angle / _USUAL_TURN, distance / _USUAL_SPEED))


class SceneCutDetector:
    """Tells, picture by picture, when the camera is suddenly somewhere else.

    A cut is reported once: a difference above `threshold`, and then none until the difference
    has been below `release` times it. The threshold is that of pictures close in time; for others
    it grows (see leniency) with their stamps' distance, or, where poses are known, with the motion
    between them. Blank pictures are never a cut; the next one that shows
    something is compared with the last one that did, for up to ten blank ones.
    """

    def __init__(self, threshold: float = THRESHOLD, release: float = 0.8) -> None:
        if not 0 < threshold < 2 or not 0 < release <= 1:
            raise ValueError(f"threshold {threshold} must be in 0..2 and release {release} in 0..1")
        self.threshold, self.release = threshold, release
        self.state = CutState()
        self.difference = math.nan  # of the last two pictures; NaN: not comparable
        self.allowed = threshold  # the threshold for these two

    def push(
        self,
        image: np.ndarray,
        stamp: float | None = None,
        pose: Callable[[], np.ndarray | None] = lambda: None,
    ) -> bool:
        """Look at the next picture.

        Args:
            image: H x W x 3 uint8 RGB.
            stamp: Seconds; None where unknown.
            pose: Gives 4 x 4, camera to world, metres, or None; asked only where it decides.

        Returns:
            Whether the image begins a new scene.
        """
        look, state = picture_features(image), self.state
        self.difference = math.nan
        if look.blank:
            forget = state.blank + 1 >= _BLANK_PATIENCE
            old = None if forget else state.look
            self.state = replace(state, look=old, blank=state.blank + 1)
            return False
        if state.look is None:
            self.state = CutState(look, stamp=stamp)
            return False
        self.difference = scene_difference(state.look, look)
        passed = 0.0 if stamp is None or state.stamp is None else stamp - state.stamp
        factor = leniency(passed)
        if factor > 1 and state.pose is not None and self.difference > self.threshold:
            factor = leniency(moving_seconds(passed, state.pose, pose()))
        self.allowed = self.threshold * factor
        cut = state.armed and self.difference > self.allowed
        armed = not cut and (state.armed or self.difference < self.release * self.allowed)
        self.state = CutState(look, armed, stamp=stamp)
        return cut

    def locate(self, stamp: float | None, pose: np.ndarray | None) -> None:
        """The pose of the picture of this stamp, if it is the last that showed something."""
        if not self.state.blank and stamp is not None and self.state.stamp == stamp:
            self.state = replace(self.state, pose=pose)

    def reset(self) -> None:
        """Forget the last picture."""
        self.state = CutState()
        self.difference = math.nan


def scene_difference(before: PictureFeatures, now: PictureFeatures) -> float:
    """Structure and colour together: 0 the same, about 1 when nothing is left. NaN: blank."""
    return structure_difference(before, now) + 0.5 * colour_difference(before, now)
