"""Triangulated points of the last seconds, carried into the present picture by the odometry."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from dyfn_core.metric.motion import MotionPoints

_NEAREST = 0.1  # metres before the camera within which a point is left out


@dataclass(frozen=True)
class MemoryOptions:
    """What is remembered, and how it ages.

    Attributes:
        seconds: age at which a point is forgotten; 0 remembers nothing.
        growth: standard deviation of log depth that a point gains per square root of a second,
            from the drift of the odometry and from what moved.
        behind: log depth by which a remembered point may lie behind the predicted surface;
            beyond it something that came between hides it.
        most_sigma: standard deviation of log depth beyond which a point is not remembered.
        most: points that are remembered; the oldest are forgotten first.
    """

    seconds: float = 3.0
    growth: float = 0.11
    behind: float = 0.7
    most_sigma: float = 0.2
    most: int = 3000


@dataclass(frozen=True)
class PointMemory:
    """The latest triangulation of each of M tracks; a value.

    Attributes:
        ids: M int64, rising.
        points: M x 3, metres in the odometry's world.
        sigma: M, standard deviation of log depth when it was triangulated.
        sigma_pixels: M, the part of it from the noise of the pixels.
        stamps: M, seconds.
    """

    ids: np.ndarray = field(default_factory=lambda: np.empty(0, np.int64))
    points: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    sigma: np.ndarray = field(default_factory=lambda: np.empty(0))
    sigma_pixels: np.ndarray = field(default_factory=lambda: np.empty(0))
    stamps: np.ndarray = field(default_factory=lambda: np.empty(0))


def remember(
    memory: PointMemory,
    points: MotionPoints,
    camera_matrix: np.ndarray,
    pose: np.ndarray,
    stamp: float,
    options: MemoryOptions,
) -> PointMemory:
    """The memory after a frame; a track that is seen again replaces its older point.

    Args:
        memory: after the frame before; it is not changed.
        points: triangulated in this frame.
        camera_matrix: 3 x 3, pixels.
        pose: 4 x 4, camera to world, metres.
        stamp: seconds. Points that are younger than this stamp are forgotten, as time went back.
        options: see MemoryOptions.
    """
    new = points.sigma < options.most_sigma
    age = stamp - memory.stamps
    old = (age >= 0) & (age < options.seconds) & ~np.isin(memory.ids, points.ids[new])
    k = camera_matrix
    rays = (points.pixels[new] - k[:2, 2]) / [k[0, 0], k[1, 1]]
    there = np.column_stack([rays, np.ones(len(rays))]) * points.depth[new, None]
    there = there @ pose[:3, :3].T + pose[:3, 3]
    stamps = np.concatenate([memory.stamps[old], np.full(len(there), float(stamp))])
    latest = np.argsort(-stamps, kind="stable")[: options.most]
    ids = np.concatenate([memory.ids[old], points.ids[new]])
    order = latest[np.argsort(ids[latest])]
    return PointMemory(
        ids[order],
        np.concatenate([memory.points[old], there])[order],
        np.concatenate([memory.sigma[old], points.sigma[new]])[order],
        np.concatenate([memory.sigma_pixels[old], points.sigma_pixels[new]])[order],
        stamps[order],
    )


def recall(
    memory: PointMemory,
    points: MotionPoints,
    camera_matrix: np.ndarray,
    pose: np.ndarray,
    stamp: float,
    size: tuple[int, int],
    options: MemoryOptions,
) -> MotionPoints:
    """The points of a frame and the remembered ones that are in its view.

    Args:
        memory: after the frame before.
        points: of this frame; a track among them is not taken from the memory.
        camera_matrix: 3 x 3, pixels.
        pose: 4 x 4, camera to world, metres.
        stamp: seconds.
        size: (H, W) of the picture.
        options: see MemoryOptions.

    Returns:
        `points` followed by the remembered ones, whose `sigma` has grown with their age.
    """
    k, (height, width) = camera_matrix, size
    here = (memory.points - pose[:3, 3]) @ pose[:3, :3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = here[:, :2] / here[:, 2:] * [k[0, 0], k[1, 1]] + k[:2, 2]
    age = stamp - memory.stamps
    seen = (here[:, 2] > _NEAREST) & (age >= 0) & (age < options.seconds)
    seen &= (pixels > 0).all(axis=1) & (pixels < [width - 1, height - 1]).all(axis=1)
    seen &= ~np.isin(memory.ids, points.ids)
    sigma = np.hypot(memory.sigma[seen], options.growth * np.sqrt(age[seen]))
    return replace(
        points,
        ids=np.concatenate([points.ids, memory.ids[seen]]),
        pixels=np.concatenate([points.pixels, pixels[seen]]),
        depth=np.concatenate([points.depth, here[seen, 2]]),
        sigma_pixels=np.concatenate([points.sigma_pixels, memory.sigma_pixels[seen]]),
        sigma=np.concatenate([points.sigma, sigma]),
    )


def unhidden(residuals: np.ndarray, seen: int, options: MemoryOptions) -> np.ndarray:
    """Which points are no remembered ones that something hides by now.

    Args:
        residuals: N, log(measured / predicted) less the frame's log scale; NaN: unknown.
        seen: how many of them, at the start, are of this frame, as recall orders them.
        options: see MemoryOptions.

    Returns:
        N bool.
    """
    kept = ~(residuals > options.behind)
    kept[:seen] = True
    return kept


def chosen(points: MotionPoints, kept: np.ndarray) -> MotionPoints:
    """Those of N points where `kept` (N bool) says so."""
    names = ("ids", "pixels", "depth", "sigma_pixels", "sigma")
    return replace(points, **{name: getattr(points, name)[kept] for name in names})
