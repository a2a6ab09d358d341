"""Poses as data sets give them -> camera to world with optical axes."""

from __future__ import annotations

import numpy as np

# Columns: optical x, y, z (right, down, forward) in a body of forward, right, down (NED).
OPTICAL_IN_NED = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


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


def ned_body_pose(body_in_world: np.ndarray) -> np.ndarray:
    """Pose of a body (forward, right, down) whose camera looks forward -> of the camera.

    The world's own axes stay as they are.
    """
    return rigid(body_in_world[:3, :3] @ OPTICAL_IN_NED, body_in_world[:3, 3])


def pytorch3d_pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """PyTorch3D's R and T (row vectors, world to camera, x left, y up) -> camera to world."""
    turn = np.array(rotation, np.float64)
    shift = np.array(translation, np.float64)
    turn[:, :2] *= -1
    shift[:2] *= -1
    return inverse(rigid(turn.T, shift))
