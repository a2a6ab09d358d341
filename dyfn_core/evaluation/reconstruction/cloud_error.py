"""How far a fused cloud is from the true one, and its PLY file (paper section 5)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from dyfn_core.files import finished_file


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

    Raises ValueError for an empty cloud.
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
    distances, _ = cKDTree(others).query(points)
    return np.asarray(distances)


def write_ply(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    """Binary PLY of N points (float32) with N x 3 uint8 RGB; it appears only when complete."""
    import trimesh  # slow to import

    cloud = trimesh.PointCloud(points, colours)
    with finished_file(path) as partial:
        partial.write_bytes(cloud.export(file_type="ply"))
