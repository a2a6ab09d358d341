"""Poses as data sets give them -> camera to world with optical axes."""

from __future__ import annotations

import numpy as np

from dyfn_core.geometry.rigid import inverse, rigid

# Columns: optical x, y, z (right, down, forward) in a body of forward, right, down (NED).
OPTICAL_IN_NED = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


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
