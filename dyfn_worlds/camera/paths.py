"""Smooth collision-free camera paths: walks, standing about, fast turns, handheld jitter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyfn_worlds.camera.cameras import CLEARANCE, CameraLens, FreeSpace, pose_at
from dyfn_worlds.camera.choices import PACES
from dyfn_worlds.render.renderer import RenderCamera

RATE = 60.0  # samples a second of a path


@dataclass(frozen=True)
class CameraPath:
    """A path over time, sampled RATE times a second and interpolated in between.

    positions: N x 3 metres; angles: N x 3 yaw, pitch, roll in radians, unwrapped.
    pace: which of PACES; jitter: standard deviation of the handheld shake, degrees.
    """

    positions: np.ndarray
    angles: np.ndarray
    lens: CameraLens
    pace: str = "walking"
    jitter: float = 0.0

    def at(self, seconds: float) -> RenderCamera:
        """The camera at a time; before the start and after the end it stands still."""
        x = float(np.clip(seconds * RATE, 0, len(self.positions) - 1))
        i = min(int(x), len(self.positions) - 2)
        t = x - i
        position = (1 - t) * self.positions[i] + t * self.positions[i + 1]
        yaw, pitch, roll = (1 - t) * self.angles[i] + t * self.angles[i + 1]
        return RenderCamera(pose_at(position, yaw, pitch, roll), self.lens.focal)

    def speed(self, seconds: float) -> tuple[float, float]:
        """Metres a second and degrees a second about a time."""
        a, b = self.at(seconds - 0.5 / RATE).pose, self.at(seconds + 0.5 / RATE).pose
        cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1) / 2
        metres = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
        return metres * RATE, float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) * RATE


def random_path(
    space: FreeSpace,
    rng: np.random.Generator,
    lens: CameraLens,
    seconds: float,
    interests: np.ndarray | None = None,
    pace: str | None = None,
) -> CameraPath:
    """A camera that walks for `seconds`: a spline between free points, looking about.

    interests: N x 3 points of which one is kept in view by some paths. pace: one of PACES; None
    draws one by their shares.
    Raises ValueError when no collision-free path is found.
    """
    shares = [share for _, _, share in PACES.values()]
    drawn = str(rng.choice(list(PACES), p=shares))
    pace = pace or drawn
    speeds, turns, _ = PACES[pace]
    jitter = float(rng.choice([0.0, 1.0])) * float(rng.lognormal(np.log(0.25), 0.7))
    count = max(int(np.ceil(seconds * RATE)) + 1, 3)
    for _ in range(30):
        points = _waypoints(space, rng, length=max(seconds * rng.uniform(*speeds), 0.05))
        if points is None:
            continue
        positions = _spline(points, count)
        if pace in ("static", "turning"):
            positions = np.repeat(positions[:1], count, axis=0)
        if pace == "static":
            jitter = 0.0
        if jitter:
            positions = positions + _shake(rng, count, seconds, jitter * 0.008)
        looked = positions[:: int(RATE / 6)]
        if (space.clearance(looked) > CLEARANCE / 2).all() and _free(space, looked):
            angles = _look_about(positions, rng, seconds, rng.uniform(*turns), interests)
            angles = angles + _shake(rng, count, seconds, np.radians(jitter))
            return CameraPath(positions, angles, lens, pace, jitter)
    raise ValueError("no collision-free camera path found")


def _free(space: FreeSpace, positions: np.ndarray) -> bool:
    return bool(space.sees(positions[:-1], positions[1:]).all())


def _shake(rng: np.random.Generator, count: int, seconds: float, size: float) -> np.ndarray:
    """count x 3 of a hand's tremor: most of it below 3 Hz, some up to 9 Hz."""
    slow, fast = (max(3, int(seconds * hertz)) for hertz in (2.5, 9))
    parts = [
        _smooth_noise(rng, count, slow) + 0.35 * _smooth_noise(rng, count, fast) for _ in range(3)
    ]
    return size * np.stack(parts, axis=1)


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
    result: np.ndarray = values[index] * (1 - fade) + values[index + 1] * fade
    return result


def _look_about(
    positions: np.ndarray,
    rng: np.random.Generator,
    seconds: float,
    turning: float,
    interests: np.ndarray | None,
) -> np.ndarray:
    """count x 3 yaw, pitch, roll: along the way, at a point, or freely, with slow turns."""
    count = len(positions)
    knots = max(2, int(seconds / 1.5))
    sway = 1.0 if turning > 0 else 0.0
    pitch = np.full(count, np.radians(rng.normal(-13, 8)))
    if interests is not None and len(interests) and rng.random() < 0.45:
        near = np.linalg.norm(interests - positions[count // 2], axis=1)
        target = interests[rng.choice(np.argsort(near)[:4])]
        way = target - positions
        yaw = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
        flat = np.maximum(np.hypot(way[:, 0], way[:, 1]), 0.5)
        pitch = np.arctan2(way[:, 2], flat) * 0.8
        turning = min(turning, 0.5)
    else:
        step = np.gradient(positions, axis=0)
        along = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
        along = along if np.linalg.norm(positions[-1] - positions[0]) > 0.5 else np.zeros(count)
        follow = rng.choice([0.0, 0.5, 1.0])
        yaw = rng.uniform(0, 2 * np.pi) * (1 - follow) + follow * along
    yaw = yaw + _smooth_noise(rng, count, knots) * turning
    pitch = pitch + _smooth_noise(rng, count, knots) * np.radians(11) * sway
    pitch = np.clip(pitch, np.radians(-65), np.radians(35))
    roll = _smooth_noise(rng, count, knots) * np.radians(3) * sway
    return np.stack([yaw, pitch, roll], axis=1)
