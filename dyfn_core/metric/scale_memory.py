"""A steady scale from the pictures alone: how the depth of the same surfaces changed, remembered.

Key points that are seen again say how much the prediction of the same surface grew beyond what the
camera's motion explains. A short memory of earlier pictures makes a correction of every frame's log
scale from that; where nothing is seen again, the frame's own scale comes back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dyfn_core.geometry.key_points import KeyPoints, find_key_points, matched
from dyfn_core.geometry.resection import resect
from dyfn_core.metric.motion import weighted_median
from dyfn_core.threads import one_blas_thread

_CELLS = (6, 8)  # rows and columns of the grid that a measurement is evened out over
_LEVELS = 5  # pictures kept, numbers that are multiples of 1, 2, 4, ...


@dataclass(frozen=True)
class ScaleMemoryOptions:
    """How much the pictures are believed.

    Attributes:
        long_side: Pixels that pictures are shrunk to.
        most: Key points of a picture.
        most_error: Pixels of reprojection beyond which a pair is an outlier.
        fewest: Pairs that a measurement needs.
        most_spread: Of its log ratios; beyond it they say nothing.
        own: Standard deviation of the log scale error of a frame that is predicted by itself.
        noise: Of a measured change at best.
        alike: Neighbouring pairs err alike: so many count as one.
        outlier: Of the references' accounts of one frame: beyond it one counts for little.
        hold: Share of the correction that is kept over a frame without a measurement.
        shared: Of a picture's key points; when fewer are seen in the latest kept picture, this
            one is kept.
    """

    long_side: int = 320
    most: int = 600
    most_error: float = 4.0
    fewest: int = 12
    most_spread: float = 0.5
    own: float = 0.15
    noise: float = 0.1
    alike: float = 10.0
    outlier: float = 0.1
    hold: float = 0.8
    shared: float = 0.5


@dataclass(frozen=True)
class SeenFrame:
    """What is kept of a frame.

    Attributes:
        key: Its key points with a valid depth, N.
        rays: N x 2 float64, (x / z, y / z).
        depth: N float64, predicted and not corrected.
        focal: Pixels of one unit of rays, at the size that key points were found at.
        correction: Of its log depth.
        variance: Of its corrected log scale, against the stream's first frame.
    """

    key: KeyPoints
    rays: np.ndarray
    depth: np.ndarray
    focal: float
    correction: float = 0.0
    variance: float = 0.0


@dataclass(frozen=True)
class ScaleMemoryState:
    """All that is remembered between two frames; a value.

    Attributes:
        kept: Frames with their numbers, the latest first.
        last: The frame before, when it was not kept.
        count: How many were kept so far.
    """

    kept: tuple[tuple[int, SeenFrame], ...] = ()
    last: SeenFrame | None = None
    count: int = 0

    @property
    def references(self) -> tuple[SeenFrame, ...]:
        """What a frame is measured against, the latest first."""
        last = () if self.last is None else (self.last,)
        return (*last, *(frame for _, frame in self.kept))


@dataclass(frozen=True)
class ScaleChange:
    """How the log depth of the same surfaces grew from one frame to another.

    Attributes:
        log_ratio: Beyond what the camera's motion explains.
        variance: Of its noise.
        points: How many pairs it was measured with.
    """

    log_ratio: float
    variance: float
    points: int


@dataclass(frozen=True)
class ScaleMemoryFound:
    """What the memory says of one frame.

    Attributes:
        correction: Of its log depth, to be added.
        references: How many earlier frames it was measured against.
        points: Most pairs with one of them.
    """

    correction: float = 0.0
    references: int = 0
    points: int = 0


def step(
    state: ScaleMemoryState,
    image: np.ndarray,
    depth: np.ndarray,
    valid: np.ndarray,
    camera_matrix: np.ndarray,
    options: ScaleMemoryOptions,
) -> tuple[ScaleMemoryState, ScaleMemoryFound]:
    """Measure a frame's scale against the frames before, and remember it.

    Args:
        state: After the frame before; it is not changed.
        image: H x W x 3 uint8 RGB.
        depth: H x W, predicted, up to scale.
        valid: H x W bool, where it is.
        camera_matrix: 3 x 3, pixels of the image.
        options: See ScaleMemoryOptions.

    Returns:
        The state after this frame, and its correction.
    """
    seen = _seen(image, depth, valid, camera_matrix, options)
    if not state.references:
        return _remembered(state, seen, 0, options), ScaleMemoryFound()
    latest = state.kept[0][1] if state.kept else None
    accounts, shared = [], 0
    with one_blas_thread():
        changes = [scale_change(reference, seen, options) for reference in state.references]
    for reference, change in zip(state.references, changes, strict=True):
        if change is not None:
            corrected = reference.correction - change.log_ratio
            accounts.append((corrected, 1 / (change.variance + reference.variance), change.points))
            shared = change.points if reference is latest else shared
    own = options.own**2
    if not accounts:
        before = state.references[0]
        left = options.hold * before.correction
        variance = options.hold * before.variance + (1 - options.hold) * own
        seen = replace(seen, correction=left, variance=variance)
        return _remembered(state, seen, 0, options), ScaleMemoryFound(left)
    values, weights, points = (np.array(part) for part in zip(*accounts, strict=True))
    past, variance = _agreed(values, weights, options.outlier), 1 / float(weights.max())
    share = own / (own + variance)
    seen = replace(seen, correction=share * past, variance=share * variance)
    found = ScaleMemoryFound(share * past, len(accounts), int(points.max()))
    return _remembered(state, seen, shared, options), found


def scale_change(
    before: SeenFrame, now: SeenFrame, options: ScaleMemoryOptions
) -> ScaleChange | None:
    """The change of scale between two frames, both ways; None when too little is seen in both.

    Each frame's points are moved by the camera's motion, found from the pixels they are seen at in
    the other one, and their depth is compared with what the other frame predicts.
    """
    first, second = matched(before.key, now.key)
    if len(first) < options.fewest:
        return None
    here, there = before.rays[first], now.rays[second]
    near, far = before.depth[first], now.depth[second]
    forward = resect(_points(here, near), there, now.focal, options.most_error)
    backward = resect(_points(there, far), here, before.focal, options.most_error)
    if forward is None or backward is None:
        return None
    good = forward.inliers & backward.inliers
    if good.sum() < options.fewest:
        return None
    grown = np.log(far[good] / forward.points[good, 2])
    shrunk = np.log(near[good] / backward.points[good, 2])
    ratios = 0.5 * (grown - shrunk)
    ratio = weighted_median(ratios, _evened(before.key.points[first][good]))
    spread = 1.4826 * float(np.median(np.abs(ratios - ratio)))
    if spread > options.most_spread:
        return None
    count = len(ratios)
    variance = options.noise**2 + spread**2 * options.alike / count
    return ScaleChange(ratio, variance, count)


def _seen(
    image: np.ndarray,
    depth: np.ndarray,
    valid: np.ndarray,
    camera_matrix: np.ndarray,
    options: ScaleMemoryOptions,
) -> SeenFrame:
    key = find_key_points(image, options.long_side, options.most)
    height, width = depth.shape
    columns, rows = np.minimum(key.points * [width, height], [width - 1, height - 1]).astype(int).T
    known = valid[rows, columns]
    key, z = key.where(known), depth[rows, columns][known].astype(np.float64)
    pixels = key.points.astype(np.float64) * [image.shape[1], image.shape[0]] - 0.5
    focal = camera_matrix[[0, 1], [0, 1]]
    rays = (pixels - camera_matrix[:2, 2]) / focal
    size = min(1.0, options.long_side / max(image.shape[:2]))
    return SeenFrame(key, rays, z, float(focal[0] * size))


def _remembered(
    state: ScaleMemoryState, seen: SeenFrame, shared: int, options: ScaleMemoryOptions
) -> ScaleMemoryState:
    """The state after this frame, which is kept when the latest kept one shows little of it.

    Of the kept ones stay the latest, and the latest whose number is a multiple of 2, 4, 8 and 16.
    shared: key points that are seen in both.
    """
    found = len(seen.key.points)
    if found < options.fewest or shared >= options.shared * found:
        return replace(state, last=seen)
    numbered = ((state.count, seen), *state.kept)
    wanted = {
        next((number for number, _ in numbered if number % 2**level == 0), None)
        for level in range(_LEVELS)
    }
    kept = tuple(pair for pair in numbered if pair[0] in wanted)
    return ScaleMemoryState(kept, None, state.count + 1)


def _agreed(values: np.ndarray, weights: np.ndarray, outlier: float) -> float:
    """The mean of several accounts; of three or more, one far from their median counts little."""
    if len(values) > 2:
        weights = weights / (1 + ((values - weighted_median(values, weights)) / outlier) ** 2)
    return float((weights * values).sum() / weights.sum())


def _points(rays: np.ndarray, depth: np.ndarray) -> np.ndarray:
    return np.asarray(np.column_stack([rays, np.ones(len(rays))]) * depth[:, None])


def _evened(points: np.ndarray) -> np.ndarray:
    """Weights that give every cell of the picture the same, N."""
    rows, columns = _CELLS
    cell = (points[:, 1] * rows).astype(int) * columns + (points[:, 0] * columns).astype(int)
    return np.asarray(1 / np.bincount(cell)[cell])
