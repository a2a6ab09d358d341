"""Rigid and similarity registration of 3D-3D pairs: closed form, and RANSAC (paper section 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

SAMPLE = 3  # pairs that fix a pose
BATCH = 128  # hypotheses scored at a time
CONFIDENCE = 0.999
REFITS = 10
FLAT = 1e-9  # second singular value over the first: below it points lie on a line


class RegistrationError(ValueError):
    """The pairs fix no pose; the message says why."""


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation. rotation: 3 x 3 float64; translation: 3 float64."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    @staticmethod
    def identity() -> Similarity:
        """The one that changes nothing."""
        return Similarity(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: np.ndarray) -> Similarity:
        """Of a 4 x 4 matrix [s R, t; 0, 1]."""
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        return Similarity(matrix[:3, :3] / scale, matrix[:3, 3].copy(), scale)

    @property
    def matrix(self) -> np.ndarray:
        """4 x 4 float64."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points ... x 3 -> the moved ones, float64."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.translation)

    def after(self, first: Similarity) -> Similarity:
        """The one that applies `first`, then this."""
        return Similarity(
            self.rotation @ first.rotation,
            self.apply(first.translation),
            self.scale * first.scale,
        )

    def inverse(self) -> Similarity:
        """The one that undoes this."""
        rotation = self.rotation.T
        return Similarity(rotation, -(rotation @ self.translation) / self.scale, 1 / self.scale)


@dataclass(frozen=True)
class Consensus:
    """What RANSAC found. inliers: N bool."""

    transform: Similarity
    inliers: np.ndarray


def procrustes(
    source: np.ndarray,
    target: np.ndarray,
    *,
    with_scale: bool = False,
    flat: float = FLAT,
) -> Similarity:
    """The least-squares motion with target = motion(source) (Kabsch; with scale: Umeyama).

    source, target: N x 3, finite. flat: points whose second singular value is not above this
    share of the first lie on a line and fix no rotation; negative accepts them.
    Raises RegistrationError for fewer than 3 pairs, or points on a line or in one place;
    ValueError for differing shapes.
    """
    a, b = _checked(source, target)
    if len(a) < SAMPLE:
        raise RegistrationError(f"too few pairs: {len(a)}, a pose needs {SAMPLE}")
    for points in (a, b):
        first, second = np.linalg.svd(points - points.mean(0), compute_uv=False)[:2]
        if second <= flat * first or (first == 0 and flat >= 0):
            raise RegistrationError("collinear: the pairs lie on a line or in one place")
    rotation, translation, scale = _solve(a[None], b[None], with_scale)
    return Similarity(rotation[0], translation[0], float(scale[0]))


def ransac_procrustes(
    source: np.ndarray,
    target: np.ndarray,
    threshold: float | np.ndarray,
    *,
    with_scale: bool = False,
    seed: int = 0,
    max_hypotheses: int = 1024,
    min_inliers: int = 16,
    min_share: float = 0.2,
    flat: float = 0.01,
) -> Consensus:
    """The motion that most pairs agree on, refitted on them; deterministic for a seed.

    source, target: N x 3. threshold: largest distance of an inlier in target's unit, one for all
    or N. Hypotheses from 3 pairs each compete by their truncated squared error; drawing stops
    when 3 inliers were met with 99.9% probability. min_inliers, min_share: what a consensus must
    have at least. flat: as in procrustes, over the inliers.
    Raises RegistrationError saying "too few pairs", "no consensus" or "collinear".
    """
    a, b = _checked(source, target)
    limit = np.broadcast_to(np.asarray(threshold, np.float64), (len(a),))
    if len(a) < max(min_inliers, SAMPLE):
        raise RegistrationError(f"too few pairs: {len(a)}, at least {min_inliers} are needed")
    best = _best_hypothesis(a, b, limit, with_scale, np.random.default_rng(seed), max_hypotheses)
    inliers = np.zeros(len(a), bool) if best is None else _within(best, a, b, limit)
    needed = max(min_inliers, math.ceil(min_share * len(a)), SAMPLE)
    transform = best
    for _ in range(REFITS):
        if transform is None or inliers.sum() < needed:
            raise RegistrationError(
                f"no consensus: {int(inliers.sum())} of {len(a)} pairs agree, {needed} are needed"
            )
        transform = procrustes(a[inliers], b[inliers], with_scale=with_scale, flat=flat)
        before, inliers = inliers, _within(transform, a, b, limit)
        if np.array_equal(before, inliers):
            break
    if transform is None or inliers.sum() < needed:
        raise RegistrationError(f"no consensus: {int(inliers.sum())} of {len(a)} pairs agree")
    return Consensus(transform, inliers)


def _checked(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3:
        raise ValueError(f"pairs must be two N x 3 arrays, got {a.shape} and {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("pairs must be finite")
    return a, b


def _solve(
    source: np.ndarray, target: np.ndarray, with_scale: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Batches B x N x 3 -> rotations B x 3 x 3, translations B x 3, scales B."""
    centre_a, centre_b = source.mean(1, keepdims=True), target.mean(1, keepdims=True)
    a, b = source - centre_a, target - centre_b
    u, values, vt = np.linalg.svd(b.transpose(0, 2, 1) @ a)
    signs = np.ones_like(values)
    signs[:, 2] = np.where(np.linalg.det(u) * np.linalg.det(vt) < 0, -1.0, 1.0)
    rotation = (u * signs[:, None, :]) @ vt
    scale = np.ones(len(a))
    if with_scale:
        scale = (values * signs).sum(1) / np.maximum((a**2).sum((1, 2)), np.finfo(float).tiny)
    moved = (rotation @ centre_a.transpose(0, 2, 1))[..., 0]
    return rotation, centre_b[:, 0] - scale[:, None] * moved, scale


def _within(
    transform: Similarity, source: np.ndarray, target: np.ndarray, limit: np.ndarray
) -> np.ndarray:
    return np.asarray(np.linalg.norm(transform.apply(source) - target, axis=1) <= limit)


def _best_hypothesis(
    source: np.ndarray,
    target: np.ndarray,
    limit: np.ndarray,
    with_scale: bool,
    rng: np.random.Generator,
    max_hypotheses: int,
) -> Similarity | None:
    best, lowest, drawn, wanted = None, math.inf, 0, float(max_hypotheses)
    while drawn < min(wanted, max_hypotheses):
        size = min(BATCH, max_hypotheses - drawn)
        drawn += size
        chosen = rng.integers(0, len(source), (size, SAMPLE))
        a, b = source[chosen], target[chosen]
        area = np.linalg.norm(np.cross(a[:, 1] - a[:, 0], a[:, 2] - a[:, 0]), axis=1)
        a, b = a[area > 0], b[area > 0]
        if not len(a):
            continue
        rotation, translation, scale = _solve(a, b, with_scale)
        moved = scale[:, None, None] * (source @ rotation.transpose(0, 2, 1))
        error = ((moved + translation[:, None] - target) ** 2).sum(-1) / limit**2
        cost = np.minimum(error, 1).sum(1)
        place = int(cost.argmin())
        if cost[place] < lowest:
            lowest = float(cost[place])
            best = Similarity(rotation[place], translation[place], float(scale[place]))
            wanted = _needed(float((error[place] <= 1).mean()))
    return best


def _needed(share: float) -> float:
    """Draws after which a sample of inliers only was met with CONFIDENCE."""
    hit = share**SAMPLE
    if hit >= 1:
        return 1
    return math.inf if hit <= 0 else math.log(1 - CONFIDENCE) / math.log1p(-hit)
