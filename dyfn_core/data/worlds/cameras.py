"""Where a camera can be in a scene: single views and smooth collision-free paths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from dyfn_core.data.worlds.renderer import Camera
from dyfn_core.data.worlds.scene import Scene

FAR = 200.0
CLEARANCE = 0.3
PROBES = 32


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
        return self.distance(origins, directions).reshape(len(points), PROBES).min(axis=1)

    def sees(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """N x 3 pairs -> whether the straight way from start to end is free."""
        step = end - start
        length = np.linalg.norm(step, axis=1)
        unit = step / np.maximum(length, 1e-9)[:, None]
        return self.distance(start, unit) >= length

    def sample_point(self, rng: np.random.Generator, heights: tuple[float, float]) -> np.ndarray:
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
            lifted = point + np.array([0, 0, rng.uniform(*heights) - floor])
            free = self.sees(point[None], lifted[None])[0]
            if free and self.clearance(lifted[None])[0] > CLEARANCE:
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
class Lens:
    """Normalised focal lengths of a camera with square pixels."""

    focal: tuple[float, float]

    @staticmethod
    def sample(rng: np.random.Generator, size: tuple[int, int]) -> Lens:
        """A horizontal field of view between 45 and 100 degrees, most often 55 to 80."""
        degrees = float(np.clip(rng.normal(66, 11), 45, 100))
        fx = 0.5 / np.tan(np.radians(degrees) / 2)
        return Lens((fx, fx * size[1] / size[0]))


def random_view(space: FreeSpace, rng: np.random.Generator, lens: Lens) -> Camera:
    """One camera at head or robot height that looks about level, more often down than up."""
    position = space.sample_point(rng, (0.7, 2.0) if rng.random() < 0.8 else (0.25, 0.7))
    pitch = np.radians(np.clip(rng.normal(-10, 13), -65, 35))
    roll = np.radians(rng.normal(0, 4))
    return Camera(pose_at(position, rng.uniform(0, 2 * np.pi), pitch, roll), lens.focal)


def random_path(
    space: FreeSpace, rng: np.random.Generator, lens: Lens, count: int, seconds: float
) -> list[Camera]:
    """`count` cameras along a walk of `seconds`: a spline between free points, looking about.

    Raises ValueError when no collision-free path is found.
    """
    for _ in range(30):
        points = _waypoints(space, rng, length=seconds * rng.uniform(0.3, 1.2))
        if points is None:
            continue
        positions = _spline(points, count)
        free = space.clearance(positions) > CLEARANCE / 2
        if free.all() and space.sees(positions[:-1], positions[1:]).all():
            return _look_about(positions, rng, lens, seconds)
    raise ValueError("no collision-free camera path found")


def _waypoints(space: FreeSpace, rng: np.random.Generator, length: float) -> np.ndarray | None:
    points = [space.sample_point(rng, (0.5, 1.6))]
    heading, travelled = rng.uniform(0, 2 * np.pi), 0.0
    for _ in range(40):
        heading += rng.normal(0, 0.9)
        way = np.array([[np.cos(heading), np.sin(heading), rng.normal(0, 0.08)]])
        way /= np.linalg.norm(way)
        room = space.distance(points[-1][None], way)[0] - 2 * CLEARANCE
        if room < 0.3:
            heading += rng.uniform(1, 2)
            continue
        step = min(room * rng.uniform(0.4, 0.9), rng.uniform(0.5, 2.5), length - travelled + 0.3)
        points.append(points[-1] + way[0] * step)
        travelled += step
        if travelled >= length:
            return np.array(points)
    return None


def _spline(points: np.ndarray, count: int) -> np.ndarray:
    """Uniform samples of a Catmull-Rom spline through the points, about even in arc length."""
    padded = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    t = np.linspace(0, 1, 20, endpoint=False)[:, None]
    pieces = []
    for i in range(len(points) - 1):
        a, b, c, d = padded[i : i + 4]
        pieces.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2
                   + (3 * b - 3 * c + d - a) * t**3)
        )  # fmt: skip
    dense = np.vstack([*pieces, points[-1:]])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    at = np.linspace(0, arc[-1], count)
    return np.stack([np.interp(at, arc, dense[:, k]) for k in range(3)], axis=1)


def _smooth_noise(rng: np.random.Generator, count: int, knots: int) -> np.ndarray:
    """A smooth random curve with unit deviation at its knots."""
    values = rng.normal(size=knots + 3)
    x = np.linspace(0, knots, count)
    index = x.astype(int)
    t = x - index
    fade = t * t * (3 - 2 * t)
    return values[index] * (1 - fade) + values[index + 1] * fade


def _look_about(
    positions: np.ndarray, rng: np.random.Generator, lens: Lens, seconds: float
) -> list[Camera]:
    count = len(positions)
    step = np.gradient(positions, axis=0)
    along = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    follow = rng.choice([0.0, 0.5, 1.0])
    knots = max(2, int(seconds / 1.5))
    yaw = rng.uniform(0, 2 * np.pi) * (1 - follow) + follow * along
    yaw = yaw + _smooth_noise(rng, count, knots) * rng.uniform(0.3, 1.2)
    yaw = yaw + _smooth_noise(rng, count, max(3, int(seconds * 4))) * 0.01
    pitch = np.radians(rng.normal(-12, 7)) + _smooth_noise(rng, count, knots) * np.radians(12)
    pitch = np.clip(pitch, np.radians(-65), np.radians(35))
    roll = _smooth_noise(rng, count, knots) * np.radians(3)
    return [
        Camera(pose_at(positions[i], yaw[i], pitch[i], roll[i]), lens.focal) for i in range(count)
    ]
