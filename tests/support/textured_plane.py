"""A camera that moves along a slanted textured plane: pictures, poses and true depth, made."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

SIZE = (180, 240)
CAMERA = np.array([[200.0, 0, 119.5], [0, 200.0, 89.5], [0, 0, 1]])
_TEXEL = 0.01  # metres of the plane in a pixel of its texture


@dataclass(frozen=True)
class PlaneView:
    """Image H x W x 3 uint8, depth H x W metres, pose 4 x 4 camera to world."""

    image: np.ndarray
    depth: np.ndarray
    pose: np.ndarray


def pose_at(place: tuple[float, float, float], turn: tuple[float, float, float]) -> np.ndarray:
    """place: metres. turn: rotation vector, radians."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array(turn, np.float64))[0]
    pose[:3, 3] = place
    return pose


def walk(frames: int, step: float = 0.04, turn: float = 0.004) -> list[np.ndarray]:
    """Poses of a camera that moves to the right and a little forward, and turns."""
    return [
        pose_at((step * i, 0.2 * step * np.sin(i), 0.3 * step * i), (0.5 * turn * i, -turn * i, 0))
        for i in range(frames)
    ]


def texture(seed: int = 0, side: int = 1200) -> np.ndarray:
    """side x side uint8: noise of three sizes."""
    draw = np.random.default_rng(seed)
    layers = [draw.random((side // size, side // size), np.float32) for size in (4, 12, 40)]
    whole = sum(cv2.resize(layer, (side, side), interpolation=cv2.INTER_CUBIC) for layer in layers)
    return np.clip(np.asarray(whole) * 85, 0, 255).astype(np.uint8)


def plane_view(pose: np.ndarray, picture: np.ndarray, camera: np.ndarray = CAMERA) -> PlaneView:
    """The plane z = 3 + 0.3 x + 0.2 y of the world, seen from a pose."""
    height, width = SIZE
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack(
        [(x - camera[0, 2]) / camera[0, 0], (y - camera[1, 2]) / camera[1, 1], np.ones(SIZE)], -1
    )
    rays = rays @ pose[:3, :3].T
    normal = np.array([-0.3, -0.2, 1.0])
    depth = (3.0 - normal @ pose[:3, 3]) / (rays @ normal)  # along the optical axis
    there = (pose[:3, 3] + depth[..., None] * rays)[..., :2] / _TEXEL + picture.shape[0] / 3
    grey = cv2.remap(
        picture,
        *np.moveaxis(there.astype(np.float32), -1, 0),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT,
    )
    return PlaneView(np.repeat(grey[..., None], 3, axis=2), depth.astype(np.float32), pose)
