"""Whether poses agree with the motion in the pictures, and whether their clock is another one.

Points that are followed from one picture to a later one must lie on the epipolar lines that the
poses of the two moments give. Poses that are looked up at a constant offset in time fit best at the
offset of their clock, where the camera's turning changes; at a constant velocity nothing tells.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from dyfn_core.geometry.rigid import inverse
from dyfn_core.geometry.tracks import TrackerState, TrackOptions, track

PAIRS = 48  # of pictures, evenly spread over a recording
SHORTEST, LONGEST = 0.2, 1.0  # seconds from a picture to the other of its pair
POINTS = 20  # that both pictures of a pair must show
RANGE, STEP, FINE = 0.5, 0.02, 0.005  # seconds: offsets that are tried
LEAST_OFFSET = 0.025  # seconds: exposure and transport may take less
TELLING = 0.3  # pixels between the best and the worst offset of a pair that tells
LEAST_PAIRS = 12
BETTER, SHARE_BETTER = 0.7, 0.6  # of the error as it is, and of the pairs
FAR = 1.2  # pixels: poses of another camera, other axes or the inverse miss by more
FAR_RATIO = 4.0  # over what the pictures alone leave
CLIPPED = 5.0  # pixels: no pair counts for more
SECOND = 1_000_000_000
_TRACKING = TrackOptions(most=150, spacing=7.0, forward_backward=0.5)
PoseAt = Callable[[int], "np.ndarray | None"]  # nanoseconds -> 4 x 4 camera to world


@dataclass(frozen=True)
class Agreement:
    """What the pictures say of poses; errors are median distances of points from their epipolar
    lines, in pixels of a picture whose longer side has 320.

    Attributes:
        error: Of the poses as they are.
        alone: Of the motion that the pictures themselves give.
        offset: Seconds that the poses' stamps are after those of pictures of the same moment; None
            where there is none, or nothing tells.
        best: The error at the offset; without one the smallest of all offsets.
    """

    error: float
    alone: float
    offset: float | None
    best: float

    @property
    def far(self) -> bool:
        """Whether the poses are of something else than this camera's motion."""
        return self.best > max(FAR, FAR_RATIO * self.alone)


@dataclass(frozen=True)
class _Pair:
    """Two pictures: their stamps, N x 3 directions (z = 1) in each, pixels per unit of these."""

    stamps: tuple[int, int]
    first: np.ndarray
    second: np.ndarray
    focal: float


class PoseAgreement:
    """Takes the pictures of a sequence; points of at most about PAIRS pairs are kept."""

    def __init__(self, expected_frames: int) -> None:
        """Begin.

        Args:
            expected_frames: How many there will be, for the choice of the pairs.
        """
        self._every = max(1, expected_frames // PAIRS)
        self._frames = 0
        self._open: deque[tuple[int, TrackerState]] = deque(maxlen=8)
        self._pairs: list[_Pair] = []

    def push(self, image: np.ndarray, stamp: int, camera_matrix: np.ndarray | None) -> None:
        """One picture.

        Args:
            image: H x W x 3 uint8 RGB, without distortion.
            stamp: Nanoseconds.
            camera_matrix: 3 x 3 in pixels; None when unknown, and the picture is not used.
        """
        index, self._frames = self._frames, self._frames + 1
        if camera_matrix is None:
            return
        while self._open and not 0 <= stamp - self._open[0][0] <= LONGEST * SECOND:
            self._open.popleft()
        if self._open and stamp - self._open[0][0] >= SHORTEST * SECOND:
            before, state = self._open.popleft()
            after = track(state, image, _TRACKING)
            pair = _pair((before, stamp), state, after, image.shape, camera_matrix)
            self._pairs += [] if pair is None else [pair]
        if index % self._every == 0:
            self._open.append((stamp, track(None, image, _TRACKING)))

    def judge(self, pose_at: PoseAt) -> Agreement | None:
        """Compare with poses.

        Args:
            pose_at: The camera's pose at a moment, None where it is not known.

        Returns:
            None when too few pictures have poses, or too little moves.
        """
        posed = [
            (pair, found)
            for pair in self._pairs
            if (found := _error(pair, pose_at, 0.0)) is not None and _moves(pair)
        ]
        if len(posed) < LEAST_PAIRS:
            return None
        alone = _mean(np.array([_alone(pair) for pair, _ in posed]))
        pairs, error = [pair for pair, _ in posed], _mean(np.array([found for _, found in posed]))
        offset, as_is, best = _best_offset(pairs, pose_at)
        with_offset = Agreement(as_is, alone, offset, best)
        if offset is None or with_offset.far:  # an offset of something else means nothing
            return Agreement(error, alone, None, min(error, best))
        return with_offset


def _best_offset(pairs: list[_Pair], pose_at: PoseAt) -> tuple[float | None, float, float]:
    """The offset that is clearly better than none, or None; the errors without and with it."""
    tried = np.arange(-round(RANGE / STEP), round(RANGE / STEP) + 1) * STEP
    errors, whole = _errors(pairs, pose_at, tried)
    telling = np.ptp(errors, axis=1) > TELLING if len(errors) else np.zeros(0, bool)
    if telling.sum() < LEAST_PAIRS:
        return None, np.inf, np.inf
    pairs = [pair for pair, tells in zip(whole, telling, strict=True) if tells]
    place = int(_means(errors[telling]).argmin())
    near = tried[place] + np.arange(-4, 5) * FINE
    fine, pairs = _errors(pairs, pose_at, np.array([0.0, *near]))
    if len(pairs) < LEAST_PAIRS:
        return None, np.inf, np.inf
    means = _means(fine)
    best = 1 + int(means[1:].argmin())
    offset, without, found = float(near[best - 1]), float(means[0]), float(means[best])
    clear = found < BETTER * without and np.mean(fine[:, best] < fine[:, 0]) >= SHARE_BETTER
    inside = 0 < place < len(tried) - 1
    if clear and inside and abs(offset) >= LEAST_OFFSET:
        return offset, without, found
    return None, without, found


def _errors(
    pairs: list[_Pair], pose_at: PoseAt, offsets: np.ndarray
) -> tuple[np.ndarray, list[_Pair]]:
    """Of the pairs whose poses are known at all offsets, pairs x offsets; and these pairs."""
    rows, kept = [], []
    for pair in pairs:
        row = []
        for offset in offsets.tolist():
            found = _error(pair, pose_at, offset)
            if found is None:
                break
            row.append(found)
        else:
            rows.append(row)
            kept.append(pair)
    return np.array(rows).reshape(len(kept), len(offsets)), kept


def _error(pair: _Pair, pose_at: PoseAt, offset: float) -> float | None:
    """Median distance from the epipolar lines, pixels; None when a pose is not known."""
    first, second = (pose_at(stamp + round(offset * SECOND)) for stamp in pair.stamps)
    if first is None or second is None:
        return None
    motion = inverse(second) @ first
    rotation, move = motion[:3, :3], motion[:3, 3]
    if np.linalg.norm(move) < 1e-6:  # no baseline: the points' own distance
        turned = pair.first @ rotation.T
        apart = turned[:, :2] / turned[:, 2:] - pair.second[:, :2]
        return float(np.median(np.linalg.norm(apart, axis=1))) * pair.focal
    across = np.cross(np.eye(3), move).T  # [move] x
    return _distance(pair, across @ rotation)


def _distance(pair: _Pair, essential: np.ndarray) -> float:
    """Median Sampson distance, pixels."""
    lines, back = pair.first @ essential.T, pair.second @ essential
    slope = np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    apart = np.abs((lines * pair.second).sum(1)) / np.maximum(slope, 1e-12)
    return float(np.median(apart)) * pair.focal


def _alone(pair: _Pair) -> float:
    """What the motion that fits the points best leaves, pixels."""
    first, second = (np.ascontiguousarray(points[:, :2]) for points in (pair.first, pair.second))
    found, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, 1 / pair.focal)
    if found is None or found.shape != (3, 3):
        return CLIPPED
    return _distance(pair, found)


def _moves(pair: _Pair) -> bool:
    """Whether most points have another place in the second picture."""
    apart = np.linalg.norm((pair.first - pair.second)[:, :2], axis=1)
    return float(np.median(apart)) * pair.focal > 1.0


def _pair(
    stamps: tuple[int, int],
    before: TrackerState,
    after: TrackerState,
    shape: tuple[int, ...],
    camera_matrix: np.ndarray,
) -> _Pair | None:
    """None with fewer than POINTS points that both show."""
    _, ours, theirs = np.intersect1d(
        before.tracks.ids, after.tracks.ids, assume_unique=True, return_indices=True
    )
    if len(ours) < POINTS:
        return None
    directions = np.linalg.inv(camera_matrix).T
    first, second = (
        np.column_stack([points, np.ones(len(points))]) @ directions
        for points in (before.tracks.points[ours], after.tracks.points[theirs])
    )
    shrunk = min(1.0, _TRACKING.long_side / max(shape[:2]))
    return _Pair(stamps, first, second, float(camera_matrix[0, 0]) * shrunk)


def _means(errors: np.ndarray) -> np.ndarray:
    """Over pairs, of each offset."""
    return np.asarray(np.minimum(errors, CLIPPED).mean(0))


def _mean(errors: np.ndarray) -> float:
    return float(np.minimum(errors, CLIPPED).mean())
