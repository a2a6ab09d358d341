"""Where a camera can be in a scene: ray queries, lenses and single views."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from dyfn_worlds.camera.choices import USUAL
from dyfn_worlds.render.renderer import RenderCamera
from dyfn_worlds.scene.scene import Scene

FAR = 200.0
CLEARANCE = 0.3
PROBES = 32
LENSES = ((38.0, 62.0), (55.0, 82.0), (80.0, 118.0))  # degrees across


class FreeSpace:
    """Ray queries against a scene's triangles (embree)."""

    def __init__(self, scene: Scene) -> None:
        mesh = trimesh.Trimesh(scene.vertices["position"], scene.triangles, process=False)
        self._rays = RayMeshIntersector(mesh)
        self._mesh = mesh
        self.viewpoints = scene.viewpoints

    def distance(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """N x 3 origins and unit directions -> N metres to the first surface, FAR without one."""
        directions = np.ascontiguousarray(directions, np.float64)
        hit = self._rays.intersects_first(origins, directions)
        out = np.full(len(origins), FAR)
        seen = hit >= 0
        corners = self._mesh.triangles[hit[seen]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        slope = np.einsum("ij,ij->i", normal, directions[seen])
        height = np.einsum("ij,ij->i", normal, corners[:, 0] - origins[seen])
        with np.errstate(divide="ignore", invalid="ignore"):
            out[seen] = np.nan_to_num(height / slope, nan=0.0, posinf=FAR)
        return out

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """N x 3 -> N metres to the nearest surface along PROBES fixed directions."""
        directions = np.tile(_sphere(PROBES), (len(points), 1))
        origins = np.repeat(points, PROBES, axis=0)
        distances = self.distance(origins, directions).reshape(len(points), PROBES)
        nearest: np.ndarray = distances.min(axis=1)
        return nearest

    def sees(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """N x 3 pairs -> whether the straight way from start to end is free."""
        step = end - start
        length = np.linalg.norm(step, axis=1)
        unit = step / np.maximum(length, 1e-9)[:, None]
        result: np.ndarray = self.distance(start, unit) >= length
        return result

    def sample_point(
        self, rng: np.random.Generator, heights: tuple[float, float], clear: float = CLEARANCE
    ) -> np.ndarray:
        """A point in free space, heights[0]..heights[1] metres above what lies below it."""
        for _ in range(200):
            start = self.viewpoints[rng.integers(len(self.viewpoints))] + [0, 0, 0.3]
            yaw = rng.uniform(0, 2 * np.pi)
            way = np.array([[np.cos(yaw), np.sin(yaw), rng.normal(0, 0.1)]])
            way /= np.linalg.norm(way)
            point = start + way[0] * self.distance(start[None], way)[0] * rng.uniform(0, 0.95)
            floor = self.distance(point[None], np.array([[0, 0, -1.0]]))[0]
            if floor >= FAR / 2:
                continue
            lifted: np.ndarray = point + np.array([0, 0, rng.uniform(*heights) - floor])
            free = self.sees(point[None], lifted[None])[0]
            if free and self.clearance(lifted[None])[0] > clear:
                return lifted
        raise ValueError("no free camera position found: is the scene closed or empty?")


def _sphere(count: int) -> np.ndarray:
    """`count` nearly even unit directions (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    z, turn = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def pose_at(position: np.ndarray, yaw: float, pitch: float, roll: float) -> np.ndarray:
    """4 x 4 camera-to-world; angles in radians, pitch positive upwards."""
    c, s = np.cos(pitch), np.sin(pitch)
    forward = np.array([c * np.cos(yaw), c * np.sin(yaw), s])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * down
    pose[:3, 1] = -np.sin(roll) * right + np.cos(roll) * down
    pose[:3, 2], pose[:3, 3] = forward, position
    return pose


@dataclass(frozen=True)
class CameraLens:
    """Normalised focal lengths of a camera with square pixels."""

    focal: tuple[float, float]

    @staticmethod
    def of_view(degrees: float, size: tuple[int, int]) -> CameraLens:
        """The lens with a horizontal field of view, for images of size (height, width)."""
        fx = 0.5 / np.tan(np.radians(degrees) / 2)
        return CameraLens((fx, fx * size[1] / size[0]))

    @staticmethod
    def sample(rng: np.random.Generator, size: tuple[int, int]) -> CameraLens:
        """Phones and head-worn cameras (38 to 62 degrees across), webcams and depth cameras (55
        to 82), wide ones on robots (80 to 118)."""
        low, high = LENSES[int(rng.choice(len(LENSES), p=[0.4, 0.42, 0.18]))]
        return CameraLens.of_view(float(rng.uniform(low, high)), size)


def random_view(
    space: FreeSpace, rng: np.random.Generator, lens: CameraLens, interests: np.ndarray
) -> RenderCamera:
    """One camera at head or robot height that looks about level, more often down than up.

    interests: N x 3; two views in three look at one of them from 0.6 to 4 m, or past it: a plant
    or the back of a chair covers one side, and the room lies behind it.
    """
    if len(interests) and rng.random() < 0.25:
        camera = _view_past(space, rng, lens, interests[rng.integers(len(interests))])
        if camera is not None:
            return camera
    if len(interests) and rng.random() < 0.65:
        camera = _view_of(space, rng, lens, interests[rng.integers(len(interests))])
        if camera is not None:
            return camera
    position = space.sample_point(rng, (0.7, 2.0) if rng.random() < 0.8 else (0.25, 0.7))
    pitch = np.radians(np.clip(rng.normal(-10, 13), -65, 35))
    roll = np.radians(rng.normal(0, 4))
    return RenderCamera(pose_at(position, rng.uniform(0, 2 * np.pi), pitch, roll), lens.focal)


def placed_view(
    space: FreeSpace,
    rng: np.random.Generator,
    lens: CameraLens,
    interests: np.ndarray,
    placement: str = USUAL,
) -> RenderCamera:
    """One camera of one of PLACEMENTS. Raises ValueError when none is found.

    usual: see random_view. close: 0.3 to 1 m before a point of interest, the room behind it.
    steep: 0.5 to 2.2 m above a point of interest or the floor, 35 to 90 degrees down. low: at a
    wheeled robot's height. above: 2 to 10 m over the ground, 20 to 90 degrees down.
    """
    if placement == "close" and len(interests):
        for _ in range(6):
            camera = _view_close(space, rng, lens, interests[rng.integers(len(interests))])
            if camera is not None:
                return camera
    if placement == "steep" and len(interests) and rng.random() < 0.7:
        for _ in range(4):
            camera = _view_down(space, rng, lens, interests[rng.integers(len(interests))])
            if camera is not None:
                return camera
    if placement in (USUAL, "close"):
        return random_view(space, rng, lens, interests)
    heights = {"steep": (0.6, 2.2), "low": (0.15, 0.5), "above": (2.0, 10.0)}[placement]
    narrow = CLEARANCE / 2 if placement == "low" else CLEARANCE
    position = space.sample_point(rng, heights, narrow)
    if placement == "low":
        pitch = rng.normal(-3, 8)
    else:
        pitch = rng.uniform(-90, -35 if placement == "steep" else -20)
    roll = np.radians(rng.normal(0, 4))
    yaw = rng.uniform(0, 2 * np.pi)
    return RenderCamera(pose_at(position, yaw, np.radians(pitch), roll), lens.focal)


def _view_close(
    space: FreeSpace, rng: np.random.Generator, lens: CameraLens, target: np.ndarray
) -> RenderCamera | None:
    """A camera 0.3 to 1 m from a point, as somebody sits before it or an arm reaches for it."""
    for _ in range(10):
        reach, around = rng.uniform(0.3, 1.0), rng.uniform(0, 2 * np.pi)
        rise = rng.uniform(0.05, 0.7)
        offset = np.array([reach * np.cos(around), reach * np.sin(around), rise])
        position = target + offset
        if not space.sees(position[None], (target + np.array([0, 0, 0.12]))[None])[0]:
            continue
        if space.clearance(position[None])[0] < 0.5 * CLEARANCE:
            continue
        yaw = around + np.pi + rng.normal(0, 0.3)
        pitch = np.clip(
            rng.uniform(-1.0, 0.1) * np.arctan2(rise, reach) + rng.normal(0, 0.2), -1.2, 0.4
        )
        roll = np.radians(rng.normal(0, 4))
        return RenderCamera(pose_at(position, yaw, float(pitch), roll), lens.focal)
    return None


def _view_down(
    space: FreeSpace, rng: np.random.Generator, lens: CameraLens, target: np.ndarray
) -> RenderCamera | None:
    """A camera above a point that looks at it 35 to 90 degrees down."""
    for _ in range(10):
        reach, slope = rng.uniform(0.45, 1.8), np.radians(rng.uniform(35, 90))
        around = rng.uniform(0, 2 * np.pi)
        flat = reach * np.cos(slope)
        offset = np.array([flat * np.cos(around), flat * np.sin(around), reach * np.sin(slope)])
        position = target + offset
        if space.clearance(position[None])[0] < 0.5 * CLEARANCE:
            continue
        if not space.sees(position[None], (target + np.array([0, 0, 0.12]))[None])[0]:
            continue
        yaw = around + np.pi + rng.normal(0, 0.15)
        pitch = float(np.clip(-slope + rng.normal(0, 0.12), -np.pi / 2, -0.5))
        return RenderCamera(pose_at(position, yaw, pitch, np.radians(rng.normal(0, 6))), lens.focal)
    return None


def _view_past(
    space: FreeSpace, rng: np.random.Generator, lens: CameraLens, target: np.ndarray
) -> RenderCamera | None:
    """A camera with a point near one side of its picture and free space ahead; None if there is
    none."""
    for _ in range(12):
        reach, around = rng.uniform(0.4, 1.2), rng.uniform(0, 2 * np.pi)
        offset = np.array([np.cos(around), np.sin(around), 0.0]) * reach
        position = target + offset + np.array([0, 0, rng.uniform(-0.2, 0.5)])
        if space.clearance(position[None])[0] < 0.8 * CLEARANCE:
            continue
        aside = np.arctan(0.5 / lens.focal[0]) * rng.uniform(0.3, 1.0) * rng.choice([-1, 1])
        yaw = around + np.pi + aside
        ahead = np.array([[np.cos(yaw), np.sin(yaw), 0.0]])
        if space.distance(position[None], ahead)[0] < 2.0:
            continue
        pitch, roll = np.radians(rng.normal(-8, 10)), np.radians(rng.normal(0, 4))
        return RenderCamera(pose_at(position, yaw, pitch, roll), lens.focal)
    return None


def _view_of(
    space: FreeSpace, rng: np.random.Generator, lens: CameraLens, target: np.ndarray
) -> RenderCamera | None:
    """A camera that sees a point from a little above; None when none is found quickly."""
    for _ in range(12):
        reach, around = rng.uniform(0.6, 4.0), rng.uniform(0, 2 * np.pi)
        rise = rng.uniform(1.1, 1.8) - target[2] if rng.random() < 0.8 else rng.uniform(-0.2, 0.6)
        offset = np.array([reach * np.cos(around), reach * np.sin(around), rise])
        position = target + offset
        if not space.sees(position[None], (target + np.array([0, 0, 0.12]))[None])[0]:
            continue
        if space.clearance(position[None])[0] < CLEARANCE:
            continue
        way = target - position
        yaw = np.arctan2(way[1], way[0]) + rng.normal(0, 0.2)
        pitch = np.arctan2(way[2], np.hypot(way[0], way[1])) + rng.normal(0.05, 0.15)
        pose = pose_at(
            position, yaw, float(np.clip(pitch, -1.2, 0.6)), np.radians(rng.normal(0, 4))
        )
        return RenderCamera(pose, lens.focal)
    return None
