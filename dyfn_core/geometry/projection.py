"""Points into the pixels of a pinhole camera, the nearest one seen in each."""

from __future__ import annotations

import numpy as np

from dyfn_core.geometry.camera import check_camera_matrix


def nearest_pixels(
    points: np.ndarray, camera_matrix: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The pixel that each point falls on, in an image of size (H, W).

    points: N x 3 in the optical frame, z > 0. camera_matrix: 3 x 3, pixels, (0, 0) the centre of
    the first. Returns rows and columns (M integers each) of the points inside the image, and
    N bool: which ones those are. Raises ValueError for a matrix that is no pinhole camera's.
    """
    k = check_camera_matrix(camera_matrix)
    height, width = size
    with np.errstate(over="ignore"):
        u = np.floor(points[:, 0] / points[:, 2] * k[0, 0] + k[0, 2] + 0.5)
        v = np.floor(points[:, 1] / points[:, 2] * k[1, 1] + k[1, 2] + 0.5)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    return v[inside].astype(int), u[inside].astype(int), inside


def render_depth(
    points: np.ndarray, camera_matrix: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Depth image of points: H x W float32, the smallest z in each pixel, NaN where there is none.

    points: N x 3 in the optical frame; those behind the camera or not finite are left out.
    camera_matrix: 3 x 3, pixels. size: (H, W). Raises ValueError as nearest_pixels does.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1) & (points[:, 2] > 1e-3)]
    rows, columns, inside = nearest_pixels(points, camera_matrix, size)
    depth = np.full(size, np.inf)
    np.minimum.at(depth, (rows, columns), points[inside, 2])
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)


def back_project(depth: np.ndarray, camera_matrix: np.ndarray) -> np.ndarray:
    """Depth image H x W -> points N x 3 float64 of its valid (finite, > 0) pixels, row-major.

    camera_matrix: 3 x 3, pixels. Raises ValueError for a matrix that is no pinhole camera's.
    """
    k = check_camera_matrix(camera_matrix)
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    z = depth[rows, columns].astype(np.float64)
    x = (columns - k[0, 2]) / k[0, 0] * z
    y = (rows - k[1, 2]) / k[1, 1] * z
    return np.column_stack([x, y, z])


def resized_camera(
    camera_matrix: np.ndarray, size: tuple[int, int], new_size: tuple[int, int]
) -> np.ndarray:
    """Pixel intrinsics of an image of size (H, W) for the same image at new_size (H, W)."""
    scale = np.array([new_size[1] / size[1], new_size[0] / size[0]])
    matrix = np.array(camera_matrix, np.float64)
    matrix[0, 0] *= scale[0]
    matrix[1, 1] *= scale[1]
    matrix[:2, 2] = (matrix[:2, 2] + 0.5) * scale - 0.5  # pixel centres
    return matrix
