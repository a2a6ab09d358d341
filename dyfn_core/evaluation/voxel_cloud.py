"""A fused cloud in bounded memory, its distance to another, and its PLY file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

BITS = 21  # of a voxel's index along an axis
HALF = 1 << (BITS - 1)
SUMS = 6  # x y z r g b


class VoxelCloud:
    """Points averaged per voxel. Memory is bounded: too many voxels become larger ones.

    size: edge of a voxel, in the points' unit. max_voxels: when there are more, the edge doubles
    (and `size` says so) and eight voxels become one.
    """

    def __init__(self, size: float, max_voxels: int = 500_000) -> None:
        if not (size > 0 and np.isfinite(size)) or max_voxels < 1:
            raise ValueError(f"voxel size and count must be above 0, got {size}, {max_voxels}")
        self.size = size
        self.max_voxels = max_voxels
        self.outside = 0
        self._index = np.zeros((0, 3), np.int64)
        self._sums = np.zeros((0, SUMS))
        self._counts = np.zeros(0)
        self._waiting: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, points: np.ndarray, colours: np.ndarray) -> None:
        """points: ... x 3; colours: ... x 3 uint8 RGB.

        Points that are not finite or beyond 2^20 voxels from the origin are left out, and counted
        in `outside`.
        """
        xyz = np.asarray(points, np.float64).reshape(-1, 3)
        rgb = np.asarray(colours, np.float64).reshape(-1, 3)
        with np.errstate(invalid="ignore"):
            kept = (np.abs(xyz) < self.size * HALF).all(1)
        self.outside += int((~kept).sum())
        self._waiting.append((xyz[kept], rgb[kept]))
        if sum(len(p) for p, _ in self._waiting) >= self.max_voxels:
            self._merge()

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean points N x 3 float64, mean colours N x 3 uint8, and points per voxel N.

        Voxels are in the order of their place in space, so that the same points in the same order
        give the same arrays.
        """
        self._merge()
        mean = self._sums / self._counts[:, None]
        return mean[:, :3], np.round(mean[:, 3:]).astype(np.uint8), self._counts.astype(np.int64)

    def __len__(self) -> int:
        self._merge()
        return len(self._counts)

    def _merge(self) -> None:
        if not self._waiting:
            return
        xyz, rgb = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
        self._waiting = []
        new = np.floor(xyz / self.size).astype(np.int64)
        self._gather(
            np.concatenate([self._index, new]),
            np.concatenate([self._sums, np.concatenate([xyz, rgb], 1)]),
            np.concatenate([self._counts, np.ones(len(xyz))]),
        )
        while len(self._counts) > self.max_voxels:
            self.size *= 2
            self._gather(self._index >> 1, self._sums, self._counts)

    def _gather(self, index: np.ndarray, sums: np.ndarray, counts: np.ndarray) -> None:
        """One row for each different index."""
        shifted = index + HALF
        key = (shifted[:, 0] << (2 * BITS)) | (shifted[:, 1] << BITS) | shifted[:, 2]
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        self._index = index[first]
        self._sums = np.stack(
            [np.bincount(inverse, sums[:, i], len(first)) for i in range(SUMS)], axis=1
        )
        self._counts = np.bincount(inverse, counts, len(first))


@dataclass(frozen=True)
class CloudError:
    """Distances between an estimated and a true cloud, in their unit.

    accuracy: mean distance from an estimated point to the nearest true one. completeness_distance:
    the other way round. chamfer: mean of the two. precision, completeness: shares of estimated
    and of true points that have the other cloud within the tolerance.
    """

    accuracy: float
    completeness_distance: float
    chamfer: float
    precision: float
    completeness: float
    tolerance: float


def cloud_error(estimated: np.ndarray, truth: np.ndarray, tolerance: float) -> CloudError:
    """Compare clouds N x 3 and M x 3 in one frame and unit.

    Raises ValueError for an empty cloud, ImportError naming the extra when scipy is missing.
    """
    if not len(estimated) or not len(truth):
        raise ValueError(f"clouds of {len(estimated)} and {len(truth)} points cannot be compared")
    to_truth = _nearest(estimated, truth)
    to_estimate = _nearest(truth, estimated)
    there, back = float(to_truth.mean()), float(to_estimate.mean())
    return CloudError(
        there,
        back,
        (there + back) / 2,
        float((to_truth <= tolerance).mean()),
        float((to_estimate <= tolerance).mean()),
        tolerance,
    )


def _nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    distances, _ = _extra("scipy.spatial").cKDTree(others).query(points)
    return np.asarray(distances)


def write_ply(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    """Binary PLY of N points (float32) with N x 3 uint8 RGB; it appears only when complete.

    Raises ImportError naming the extra when plyfile is missing.
    """
    plyfile = _extra("plyfile")
    names = [*((axis, "f4") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))]
    rows = np.empty(len(points), names)
    for column, axis in enumerate("xyz"):
        rows[axis] = points[:, column]
    for column, colour in enumerate(("red", "green", "blue")):
        rows[colour] = colours[:, column]
    partial = path.with_name(f"{path.name}.partial")
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(partial))
    partial.replace(path)


def _extra(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name.partition('.')[0]} is needed for this: install the package with its `eval` "
            "extra"
        ) from error
