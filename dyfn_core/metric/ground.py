"""The ground plane in a predicted cloud, with gravity known: scale from the camera's height."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dyfn_core.metric.plausible import middle_depth
from dyfn_core.metric.references import Evidence

_GRID = 64  # samples along the longer side
_FEWEST = 40  # samples of a plane
_BELOW = 0.1  # share of the samples that may lie clearly below the ground
_BAND = 0.12  # relative distance to the plane within which a sample may belong to it
_BIN = 0.05  # of the histogram of log heights


class GroundView(Protocol):
    """A predicted cloud. points: H x W x 3, up to scale. valid: H x W bool."""

    @property
    def points(self) -> np.ndarray: ...

    @property
    def valid(self) -> np.ndarray: ...


class NoGroundError(ValueError):
    """The cloud shows no plausible ground; `kind` says why in short, the text with numbers."""

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(f"{kind}: {detail}")
        self.kind = kind


@dataclass(frozen=True)
class Ground:
    """normal . p + distance = 0, normal up, in the optical frame and the cloud's unit.

    spread: robust standard deviation of the residuals relative to the distance.
    share: of the valid samples that lie on the plane.
    """

    normal: np.ndarray
    distance: float
    spread: float
    share: float


def up_from_pitch(pitch: float) -> np.ndarray:
    """Up in the optical frame of a camera without roll. pitch: radians, positive looks down."""
    return np.array([0.0, -math.cos(pitch), -math.sin(pitch)])


def fit_ground(
    points: np.ndarray,
    valid: np.ndarray,
    up: np.ndarray,
    *,
    tilt: float = math.radians(15),
    min_share: float = 0.04,
) -> Ground:
    """The lowest large plane whose normal is within `tilt` (radians) of `up`.

    points: H x W x 3, optical frame, any unit; valid: H x W bool; up: 3.
    Raises NoGroundError: too few samples that face up, a plane of less than min_share of the
    samples, one tilted too far, or one with much of the scene below it (a table, not the floor).
    """
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    cloud, usable = _thinned(points, valid)
    total = int(usable.sum())
    facing = usable & (_normals(cloud, usable) @ up >= math.cos(1.5 * tilt))
    heights = -(cloud @ up)
    facing &= heights > 0
    if facing.sum() < _FEWEST:
        few = f"{int(facing.sum())} of {total} samples face up, needs {_FEWEST}"
        raise NoGroundError("nothing faces up", few)
    level = _lowest_level(heights[facing])
    near = facing & (np.abs(np.log(np.where(facing, heights, level) / level)) < 2 * _BAND)
    normal, distance = _refined(cloud[near], up)
    if float(normal @ up) < math.cos(tilt):
        angle = math.degrees(math.acos(min(float(normal @ up), 1.0)))
        allowed = f"allowed {math.degrees(tilt):.0f}"
        raise NoGroundError("the plane is tilted", f"by {angle:.0f} degrees, {allowed}")
    residual = (cloud[usable] @ normal + distance) / distance
    on = np.abs(residual) < _BAND
    share = float(on.mean())
    if share < min_share or on.sum() < _FEWEST:
        raise NoGroundError("the plane is small", f"{share:.1%}, needs {min_share:.1%}")
    below = float((residual < -2 * _BAND).mean())
    if below > _BELOW:
        raise NoGroundError("much lies below the plane", f"{below:.0%}, allowed {_BELOW:.0%}")
    spread = 1.4826 * float(np.median(np.abs(residual[on])))
    return Ground(normal, distance, spread, share)


def ground_evidence(
    view: GroundView, up: np.ndarray, height: float, stamp: float, **options: float
) -> Evidence:
    """One pair: the plane's distance, and the camera's known height over it in metres."""
    try:
        ground = fit_ground(view.points, view.valid, up, **options)
    except NoGroundError as error:
        reason = f"no ground plane ({error.kind})"
        return Evidence(stamp, np.empty(0), np.empty(0), Counter({reason: 1}))
    middle = middle_depth(view.points[..., 2], view.valid)
    return Evidence(stamp, np.array([ground.distance]), np.array([height]), middle=middle)


def _thinned(points: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    step = max(1, max(valid.shape) // _GRID)
    cloud = np.asarray(points[step // 2 :: step, step // 2 :: step], np.float64)
    usable = valid[step // 2 :: step, step // 2 :: step] & np.isfinite(cloud).all(axis=-1)
    return np.where(usable[..., None], cloud, 0.0), usable


def _normals(cloud: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """h x w x 3 unit normals facing the camera; zero where a neighbour is missing."""
    normals = np.zeros_like(cloud)
    across = cloud[1:-1, 2:] - cloud[1:-1, :-2]
    down = cloud[2:, 1:-1] - cloud[:-2, 1:-1]
    cross = np.cross(down, across)
    length = np.linalg.norm(cross, axis=-1, keepdims=True)
    known = usable[1:-1, 2:] & usable[1:-1, :-2] & usable[2:, 1:-1] & usable[:-2, 1:-1]
    good = known[..., None] & (length > 0)
    unit = np.where(good, cross / np.where(good, length, 1.0), 0.0)
    flip = np.sign(-(unit * cloud[1:-1, 1:-1]).sum(-1, keepdims=True))
    normals[1:-1, 1:-1] = unit * flip
    return normals


def _lowest_level(heights: np.ndarray) -> float:
    """The greatest height below the camera at which samples are nearly as dense as anywhere."""
    logs = np.log(heights)
    edges = np.arange(logs.min() - 2 * _BIN, logs.max() + 3 * _BIN, _BIN)
    counts = np.histogram(logs, edges)[0].astype(float)
    density = np.convolve(counts, [0.25, 0.5, 1.0, 0.5, 0.25], mode="same")
    peaks = density >= 0.4 * density.max()
    best = int(np.flatnonzero(peaks).max())
    while best > 0 and density[best - 1] > density[best]:
        best -= 1
    return float(np.exp(edges[best] + _BIN / 2))


def _refined(cloud: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, float]:
    """Total least squares plane, reweighted (Tukey) four times. cloud: N x 3."""
    weight = np.ones(len(cloud))
    normal, distance = up, 1.0
    for _ in range(4):
        centre = np.average(cloud, axis=0, weights=weight)
        offset = (cloud - centre) * np.sqrt(weight)[:, None]
        normal = np.linalg.eigh(offset.T @ offset)[1][:, 0]
        normal = normal if normal @ up > 0 else -normal
        distance = -float(normal @ centre)
        residual = cloud @ normal + distance
        sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-3 * abs(distance))
        weight = np.clip(1 - (residual / (4.685 * sigma)) ** 2, 1e-6, 1) ** 2
    if distance <= 0:
        raise NoGroundError("the plane lies above the camera", f"by {-distance:.2f}")
    return normal, distance
