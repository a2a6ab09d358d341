"""A made room: a textured box seen by a moving camera, with exact depth, poses and matches."""

from __future__ import annotations

import numpy as np

from dyfn_core.data.frames import RgbdFrame
from dyfn_core.evaluation.reconstruction.matching import Matches

SIZE = (60, 80)
FOCAL = 60.0
HALF = np.array([2.0, 1.2, 3.0])  # of the room, metres


def camera_pose(index: int) -> np.ndarray:
    """4 x 4 camera to world: a curved walk that looks around."""
    yaw, pitch = 0.05 * index, 0.1 * np.sin(0.4 * index)
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    tilt = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )
    pose = np.eye(4)
    pose[:3, :3] = turn @ tilt
    pose[:3, 3] = [0.8 * np.sin(0.2 * index), 0.2 * np.cos(0.3 * index), -1.5 + 0.06 * index]
    return pose


def room_frame(index: int) -> RgbdFrame:
    """RGB and exact depth (float32) of the box's inside."""
    height, width = SIZE
    pose = camera_pose(index)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack(
        [(u - (width - 1) / 2) / FOCAL, (v - (height - 1) / 2) / FOCAL, np.ones(SIZE)], -1
    )
    turned = rays @ pose[:3, :3].T
    depth = ((np.sign(turned) * HALF - pose[:3, 3]) / turned).min(-1)
    hit = pose[:3, 3] + turned * depth[..., None]
    waves = np.sin(hit * [7, 9, 5])[..., [1, 2, 0]] + np.sin(hit * [17, 13, 19] + [1, 2, 3])
    image = np.clip(127 + 60 * waves, 0, 255).astype(np.uint8)
    intrinsics = np.array([FOCAL / width, FOCAL / height, 0.5, 0.5], np.float32)
    return RgbdFrame(image, depth.astype(np.float32), intrinsics, pose)


class RoomSequence:
    """Frames of the room as a FrameSequence."""

    name = "room"

    def __init__(self, frames: int) -> None:
        self.frames = frames

    def __len__(self) -> int:
        return self.frames

    def read(self, index: int) -> RgbdFrame:
        return room_frame(index)


class ExactMatcher:
    """Matches by geometry: knows which frame an image is, and where its points are in another."""

    def __init__(self, frames: int) -> None:
        self.frames = [room_frame(index) for index in range(frames)]

    def describe(self, image: np.ndarray) -> int:
        return next(i for i, f in enumerate(self.frames) if np.array_equal(f.image, image))

    def match(self, first: int, second: int) -> Matches:
        height, width = SIZE
        a, b = self.frames[first], self.frames[second]
        v, u = (g.ravel().astype(float) for g in np.mgrid[1:height:3, 1:width:3])
        z = a.depth[v.astype(int), u.astype(int)].astype(float)
        points = np.stack([(u - (width - 1) / 2) * z, (v - (height - 1) / 2) * z, FOCAL * z], -1)
        world = (points / FOCAL) @ a.pose[:3, :3].T + a.pose[:3, 3]
        seen = (world - b.pose[:3, 3]) @ b.pose[:3, :3]
        x = seen[:, 0] / seen[:, 2] * FOCAL + (width - 1) / 2
        y = seen[:, 1] / seen[:, 2] * FOCAL + (height - 1) / 2
        inside = (seen[:, 2] > 0.1) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return Matches(np.stack([u, v], -1)[inside], np.stack([x, y], -1)[inside])
