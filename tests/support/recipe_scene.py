"""A floor, a box and a wall before a robot: pictures of them whose depth PinholeModel reads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyfn_core.geometry.rigid import quaternion_rotation, rigid
from tests.support.pinhole import FOV_X

SIZE = (48, 64)
FOCAL = SIZE[1] / 2 / np.tan(np.radians(FOV_X / 2))
METRES = 2.0  # in one unit of the model, whose depth then reaches from 1 m to 3 m
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # axes of a camera that looks ahead


@dataclass(frozen=True)
class Scene:
    """In the robot's frame (x ahead, z up), metres.

    floor: whether there is one, at z = 0. box: low and high corner. wall: its x.
    """

    floor: bool = True
    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    wall: float = 2.6


def mount(height: float, left: float = 0.0, down: float = 0.0, x: float = 0.0) -> np.ndarray:
    """4 x 4 of a camera's optical frame in the robot's; left, down: degrees that it is turned."""
    yaw, pitch = np.radians(left) / 2, np.radians(down) / 2
    turn = quaternion_rotation(np.cos(yaw), 0, 0, np.sin(yaw))
    turn = turn @ quaternion_rotation(np.cos(pitch), 0, np.sin(pitch), 0)
    return rigid(turn @ OPTICAL, np.array([x, 0.0, height]))


def camera_matrix() -> np.ndarray:
    """3 x 3, pixels, of the camera that PinholeModel takes for given."""
    centre = (SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2
    return np.array([[FOCAL, 0, centre[0]], [0, FOCAL, centre[1]], [0, 0, 1]])


def scene_depth(scene: Scene, pose: np.ndarray) -> np.ndarray:
    """H x W metres along the optical axis. pose: of the camera, see mount."""
    matrix = camera_matrix()
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.stack(
        [(u - matrix[0, 2]) / FOCAL, (v - matrix[1, 2]) / FOCAL, np.ones(SIZE)], axis=-1
    )
    rays, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.where(rays[..., 0] > 0, (scene.wall - origin[0]) / rays[..., 0], np.inf)
        if scene.floor:
            floor = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], np.inf)
            found = np.minimum(found, floor)
        if scene.box is not None:
            sides = [(np.array(corner) - origin) / rays for corner in scene.box]
            enters = np.minimum(*sides).max(axis=-1)
            leaves = np.maximum(*sides).min(axis=-1)
            hit = (enters > 0) & (enters <= leaves)
            found = np.where(hit, np.minimum(found, enters), found)
    return found


def picture(depth: np.ndarray) -> np.ndarray:
    """H x W metres from METRES / 2 to METRES * 3 / 2 -> H x W x 3 uint8."""
    red = depth / METRES - 0.5
    assert 0 <= red.min() <= red.max() <= 1, f"{depth.min()} to {depth.max()} m cannot be shown"
    zero = np.zeros_like(red)
    return np.round(np.stack([red, zero, zero], axis=-1) * 255).astype(np.uint8)
