"""Measured distances beside a predicted depth map -> pairs of predicted and measured depth."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from dyfn_core.geometry.camera import check_camera_matrix
from dyfn_core.geometry.projection import nearest_pixels
from dyfn_core.metric.plausible import middle_depth

MOST_POINTS = 400  # of one message; more say the same
NEARER, FARTHER = "nearer than reference_min_depth", "beyond reference_max_depth"
_EDGE = 1.2  # depths of neighbouring pixels that differ by more make an edge
_NEAREST_SHARE = 0.1
_EMPTY = np.empty(0)


class DepthView(Protocol):
    """Predicted depth of one frame.

    depth: H x W float32, up to scale. valid: H x W bool. camera_matrix: 3 x 3, pixels.
    frame_id: name of the camera's optical frame; "" when it has none.
    """

    @property
    def depth(self) -> np.ndarray: ...

    @property
    def valid(self) -> np.ndarray: ...

    @property
    def camera_matrix(self) -> np.ndarray: ...

    @property
    def frame_id(self) -> str: ...


@dataclass(frozen=True)
class Evidence:
    """What one measurement says: N pairs, both float64 and > 0.

    stamp: of the predicted frame, seconds. predicted: in the stream's unit. measured: metres.
    dropped: points that could not be used, by reason. middle: median of the frame's valid
    predicted depth; NaN unknown.
    """

    stamp: float
    predicted: np.ndarray
    measured: np.ndarray
    dropped: Counter[str] = field(default_factory=Counter)
    middle: float = math.nan

    def within(self, nearest: float, farthest: float) -> Evidence:
        """Without the pairs whose measured metres are out of bounds, which are counted."""
        near, far = self.measured < nearest, self.measured > farthest
        if not near.any() and not far.any():
            return self
        good, dropped = ~(near | far), Counter(self.dropped)
        for reason, out in ((NEARER, near), (FARTHER, far)):
            if out.any():
                dropped[reason] += int(out.sum())
        return replace(
            self, predicted=self.predicted[good], measured=self.measured[good], dropped=dropped
        )


class Reference(Protocol):
    """A measurement that can be laid beside a predicted frame."""

    def evidence(self, view: DepthView, stamp: float) -> Evidence: ...


@dataclass(frozen=True)
class PointReference:
    """Measured points, such as a lidar's or a radar's.

    Attributes:
        points: N x 3 metres in the camera's optical frame, in any order; non-finite ones count
            as missing.
    """

    points: np.ndarray

    def evidence(self, view: DepthView, stamp: float) -> Evidence:
        """Pairs along the optical axis, at the nearest pixel of each point.

        Args:
            view: The predicted frame.
            stamp: Its seconds.

        Returns:
            Predicted and measured depth, one pair a usable point.
        """
        dropped: Counter[str] = Counter()
        points = np.asarray(self.points, np.float64).reshape(-1, 3)
        finite = np.isfinite(points[:, 0]) & np.isfinite(points[:, 1]) & np.isfinite(points[:, 2])
        points = _keep(points, finite, "missing", dropped)
        before = np.asarray(points[:, 2] > 1e-3)
        points = _keep(points, before, "behind the camera", dropped)
        height, width = view.depth.shape
        rows, columns, inside = nearest_pixels(points, view.camera_matrix, (height, width))
        dropped["outside the image"] += int((~inside).sum())
        return _pairs(view, rows, columns, points[inside, 2], stamp, dropped)


@dataclass(frozen=True)
class DepthReference:
    """A measured depth image of the same view.

    Attributes:
        depth: h x w metres at any resolution, registered to the camera; NaN or values <= 0 are
            missing.
    """

    depth: np.ndarray

    def evidence(self, view: DepthView, stamp: float) -> Evidence:
        """Pairs at the pixel that the centre of each depth pixel falls on.

        Args:
            view: The predicted frame.
            stamp: Its seconds.

        Returns:
            Predicted and measured depth, one pair a usable pixel.
        """
        dropped: Counter[str] = Counter()
        depth = np.asarray(self.depth, np.float64)
        known = np.isfinite(depth) & (depth > 0)
        dropped["missing"] += int(depth.size - known.sum())
        rows, columns = np.nonzero(known)
        height, width = view.depth.shape
        measured = depth[rows, columns]
        rows = (2 * rows + 1) * height // (2 * depth.shape[0])
        columns = (2 * columns + 1) * width // (2 * depth.shape[1])
        return _pairs(view, rows, columns, measured, stamp, dropped)


@dataclass(frozen=True)
class ConeReference:
    """One distance of a sensor that sees a whole cone, such as an ultrasonic ranger.

    Attributes:
        hit: 3, metres: the point at the measured distance on the cone's axis, in the camera's
            optical frame.
        half_angle: Half the opening angle of the cone, radians.
        nearest: Whether the sensor answers to the nearest surface in the cone (sound); else to
            the middle of what it sees (a narrow infrared beam).
    """

    hit: np.ndarray
    half_angle: float
    nearest: bool

    def evidence(self, view: DepthView, stamp: float) -> Evidence:
        """One pair of radial distances: the footprint's 10th percentile, or its median.

        The footprint is every valid pixel whose ray is within half_angle of the hit's, and at
        least the pixels next to the axis. The 10th percentile, not the minimum, because a few
        flying pixels at a depth edge would decide the minimum. The cone's apex is taken to be
        in the camera's centre, the hit's distance is measured from there.

        Args:
            view: The predicted frame.
            stamp: Its seconds.

        Returns:
            One pair of distances; none when the footprint shows too little.
        """
        hit = np.asarray(self.hit, np.float64).reshape(3)
        distance = float(np.linalg.norm(hit))
        if not math.isfinite(distance) or distance <= 0:
            return Evidence(stamp, _EMPTY, _EMPTY, Counter({"missing": 1}))
        if hit[2] <= 1e-3:
            return Evidence(stamp, _EMPTY, _EMPTY, Counter({"behind the camera": 1}))
        k = check_camera_matrix(view.camera_matrix)
        height, width = view.depth.shape
        x = (np.arange(width) - k[0, 2]) / k[0, 0]
        y = (np.arange(height)[:, None] - k[1, 2]) / k[1, 1]
        norm = np.sqrt(x * x + y * y + 1)
        cosine = (x * hit[0] + y * hit[1] + hit[2]) / (norm * distance)
        widest = max(self.half_angle, 1.5 / min(k[0, 0], k[1, 1]))
        footprint = cosine >= math.cos(min(widest, math.pi / 2))
        if not footprint.any():
            return Evidence(stamp, _EMPTY, _EMPTY, Counter({"outside the image": 1}))
        usable = footprint & view.valid
        if usable.sum() < max(0.5 * footprint.sum(), 1):
            return Evidence(stamp, _EMPTY, _EMPTY, Counter({"no predicted depth": 1}))
        radial = (view.depth * norm)[usable]
        predicted = float(np.quantile(radial, _NEAREST_SHARE if self.nearest else 0.5))
        return Evidence(
            stamp,
            np.array([predicted]),
            np.array([distance]),
            middle=middle_depth(view.depth, view.valid),
        )


def _keep(points: np.ndarray, good: np.ndarray, reason: str, dropped: Counter[str]) -> np.ndarray:
    dropped[reason] += int((~good).sum())
    kept: np.ndarray = points[good]
    return kept


def _pairs(
    view: DepthView,
    rows: np.ndarray,
    columns: np.ndarray,
    measured: np.ndarray,
    stamp: float,
    dropped: Counter[str],
) -> Evidence:
    """Predicted depth at the pixels, without those at an edge of it; evenly thinned out."""
    if len(rows) > 4 * MOST_POINTS:
        few = np.linspace(0, len(rows) - 1, 4 * MOST_POINTS).astype(int)
        dropped["thinned out"] += len(rows) - len(few)
        rows, columns, measured = rows[few], columns[few], measured[few]
    predicted = view.depth[rows, columns].astype(np.float64)
    valid = view.valid[rows, columns] & np.isfinite(predicted) & (predicted > 0)
    dropped["no predicted depth"] += int((~valid).sum())
    edge = valid & _at_edge(view, rows, columns, predicted)
    dropped["at a depth edge"] += int(edge.sum())
    good = np.flatnonzero(valid & ~edge)
    if len(good) > MOST_POINTS:
        dropped["thinned out"] += len(good) - MOST_POINTS
        good = good[np.linspace(0, len(good) - 1, MOST_POINTS).astype(int)]
    kept = Counter({reason: count for reason, count in dropped.items() if count})
    measured = np.asarray(measured, np.float64)[good]
    return Evidence(stamp, predicted[good], measured, kept, middle_depth(view.depth, view.valid))


def _at_edge(
    view: DepthView, rows: np.ndarray, columns: np.ndarray, centre: np.ndarray
) -> np.ndarray:
    """Whether a valid neighbour among the eight is nearer or farther by more than a fifth."""
    height, width = view.depth.shape
    edge = np.zeros(len(rows), bool)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            r = np.clip(rows + down, 0, height - 1)
            c = np.clip(columns + right, 0, width - 1)
            other = view.depth[r, c]
            with np.errstate(invalid="ignore", divide="ignore"):
                ratio = other / centre
            edge |= view.valid[r, c] & ((ratio > _EDGE) | (ratio < 1 / _EDGE))
    return edge
