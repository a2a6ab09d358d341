"""A camera that walks towards a wall."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

SIZE = (36, 48)

CAMERA = np.array([[40.0, 0, 23.5], [0, 40.0, 17.5], [0, 0, 1]])

WALL = 4.02  # metres from the origin along the world's z; on no border of voxels


def camera_pose(index: int) -> np.ndarray:
    """Walks towards the wall and turns about the optical axis."""
    made = np.eye(4)
    made[:3, :3] = Rotation.from_euler("z", 5 * index, degrees=True).as_matrix()
    made[:3, 3] = [0.1 * index, 0, 0.3 * index]
    return made
