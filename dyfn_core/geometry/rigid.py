"""Rigid motions: rotation and translation as 4 x 4 matrices."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


def rigid(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """3 x 3 and 3 -> 4 x 4 float64."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def inverse(pose: np.ndarray) -> np.ndarray:
    """The inverse of a rigid 4 x 4."""
    rotation = pose[:3, :3].T
    return rigid(rotation, -rotation @ pose[:3, 3])


def quaternion_rotation(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Quaternion (normalised here) -> 3 x 3. Raises ValueError for one of length 0."""
    values = np.array([w, x, y, z], np.float64)
    length = np.linalg.norm(values)
    if not length > 0:
        raise ValueError(f"no rotation: quaternion {values.tolist()}")
    w, x, y, z = values / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """The pose on the way from one rigid 4 x 4 to another.

    Args:
        first: Where the way begins.
        second: Where it ends.
        share: Of the way, 0 to 1.

    Returns:
        4 x 4: the rotation at constant angular velocity, the translation on the straight line.
    """
    turn = Slerp([0, 1], Rotation.from_matrix([first[:3, :3], second[:3, :3]]))(share)
    return rigid(turn.as_matrix(), (1 - share) * first[:3, 3] + share * second[:3, 3])


def size_of(motion: np.ndarray) -> tuple[float, float]:
    """How far a rigid 4 x 4 turns (radians) and moves (in its unit)."""
    cosine = (float(np.trace(motion[:3, :3])) - 1) / 2
    sine = float(np.linalg.norm(motion[[2, 0, 1], [1, 2, 0]] - motion[[1, 2, 0], [2, 0, 1]])) / 2
    return math.atan2(sine, cosine), float(np.linalg.norm(motion[:3, 3]))
