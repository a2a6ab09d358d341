"""What moves and what changes in a clip: actors' ways over time, and the light's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyfn_worlds.camera.cameras import FAR, FreeSpace
from dyfn_worlds.camera.paths import CameraPath
from dyfn_worlds.render.renderer import RenderCamera
from dyfn_worlds.scene.actors import Actor, Placement

LIGHTING = {"steady": 0.5, "drift": 0.2, "switch": 0.18, "dip": 0.12}
STEP_HEIGHT = 0.25


@dataclass(frozen=True)
class Way:
    """One actor's way over time.

    floor: K x 3 points of a straight way over the floor; pauses: seconds at both ends.
    speed: metres a second; spin: radians a second of turning on the spot, for stiff things.
    """

    actor: int
    floor: np.ndarray
    speed: float
    pause: float
    start: float
    yaw: float
    spin: float
    stride: float

    def at(self, seconds: float) -> Placement:
        """There and back again, with a pause at both ends."""
        length = float(np.linalg.norm(self.floor[-1] - self.floor[0]))
        walk = length / self.speed if self.speed > 0 else 0.0
        if walk < 1e-6:
            yaw = self.yaw + self.spin * np.sin(0.9 * (seconds + self.start))
            return self._placement(0.0, yaw, False, seconds / 1.2)
        lap, t = divmod(seconds + self.start, walk + self.pause)
        moving = t < walk
        share = min(t / walk, 1.0)
        back = int(lap) % 2 == 1
        heading = np.arctan2(*(self.floor[-1] - self.floor[0])[[1, 0]])
        yaw = heading + self.yaw + (np.pi if back and not self.spin else 0.0)
        if self.spin:
            yaw += self.spin * np.sin(0.9 * (seconds + self.start))
        phase = share * length / self.stride if moving else seconds / 1.2
        return self._placement(1 - share if back else share, yaw, moving, phase)

    def _placement(self, share: float, yaw: float, walking: bool, phase: float) -> Placement:
        at = share * (len(self.floor) - 1)
        i = min(int(at), len(self.floor) - 2)
        x, y, z = (1 - (at - i)) * self.floor[i] + (at - i) * self.floor[i + 1]
        return Placement(
            self.actor, (float(x), float(y), float(z)), float(yaw), walking, float(phase)
        )


def stage(
    space: FreeSpace,
    rng: np.random.Generator,
    actors: list[Actor],
    path: CameraPath,
    seconds: float,
) -> list[Way]:
    """Ways for some of the actors, each in front of the camera at some time and off its path."""
    ways: list[Way] = []
    for index in rng.permutation(len(actors)):
        for _ in range(8):
            seen = path.at(rng.uniform(0, seconds))
            way = _way(space, rng, int(index), actors[index], seen)
            if way is not None and _clear(way, actors[index], ways, actors, path, seconds):
                ways.append(way)
                break
    return ways


def stand(
    space: FreeSpace,
    rng: np.random.Generator,
    actors: list[Actor],
    camera: RenderCamera,
    count: int,
) -> tuple[Placement, ...]:
    """Up to `count` actors in front of a single view, somewhere in their loops."""
    placed: list[Placement] = []
    for index in rng.permutation(len(actors))[:count]:
        for _ in range(6):
            way = _way(space, rng, int(index), actors[index], camera)
            if way is None:
                continue
            place = way.at(rng.uniform(0, 30))
            apart = [np.linalg.norm(np.subtract(place.position, p.position)[:2]) for p in placed]
            away = np.linalg.norm((camera.pose[:3, 3] - place.position)[:2])
            if away > actors[index].radius + 0.35 and all(d > 0.8 for d in apart):
                placed.append(place)
                break
    return tuple(placed)


def _way(
    space: FreeSpace, rng: np.random.Generator, index: int, actor: Actor, camera: RenderCamera
) -> Way | None:
    """A straight way over free floor that starts where the camera looks; None without room."""
    ahead = camera.pose[:3, 2] + camera.pose[:3, 0] * rng.normal(0, 0.3)
    bearing = np.arctan2(ahead[1], ahead[0])
    eye = camera.pose[:3, 3]
    start = _floor(
        space, eye + rng.uniform(1.0, 4.5) * np.array([np.cos(bearing), np.sin(bearing), 0])
    )
    if (
        start is None
        or not space.sees(eye[None], start[None] + np.array([0, 0, 0.6 * actor.height]))[0]
    ):
        return None
    heading, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.8, 4.0)
    walks = rng.random() < (0.75 if not actor.stiff else 0.6)
    count = int(length / 0.25) + 2 if walks else 2
    reach = np.linspace(0, length if walks else 0.01, count)
    step = np.array([np.cos(heading), np.sin(heading), 0.0])
    floor = [_floor(space, start + r * step + [0, 0, 0.5]) for r in reach]
    points = [p for p in floor if p is not None]
    if len(points) < count or np.abs(np.diff([p[2] for p in points])).max() > STEP_HEIGHT:
        return None
    if not _roomy(space, np.array(points), actor) or not _wide(space, start):
        return None
    return Way(
        actor=index,
        floor=np.array(points),
        speed=float(rng.uniform(0.5, 1.4) if not actor.stiff else rng.uniform(0.1, 0.9)) * walks,
        pause=float(rng.exponential(1.5)),
        start=float(rng.uniform(0, 20)),
        yaw=float(rng.uniform(0, 2 * np.pi)) if actor.stiff or not walks else 0.0,
        spin=float(rng.choice([0.0, rng.uniform(0.2, 1.5)])) if actor.stiff else 0.0,
        stride=actor.stride,
    )


def _floor(space: FreeSpace, point: np.ndarray) -> np.ndarray | None:
    """What lies below a free point, at most 2.5 m; None otherwise."""
    drop = float(space.distance(point[None], np.array([[0.0, 0, -1]]))[0])
    return None if drop >= min(FAR, 2.5) else point - [0, 0, drop]


def _wide(space: FreeSpace, start: np.ndarray) -> bool:
    """Whether the floor goes on around a point: it is no table top."""
    around = np.arange(8) * np.pi / 4
    ring = start + 0.6 * np.column_stack([np.cos(around), np.sin(around), np.zeros(8)])
    drops = space.distance(ring + np.array([0, 0, 0.1]), np.tile([0.0, 0, -1.0], (8, 1)))
    return int((drops > 0.1 + STEP_HEIGHT).sum()) <= 1


def _roomy(space: FreeSpace, points: np.ndarray, actor: Actor) -> bool:
    """Whether nothing is within the actor's radius of its way, from the ankles to the head."""
    around = np.arange(8) * np.pi / 4
    rays = np.column_stack([np.cos(around), np.sin(around), np.zeros(8)])
    rises = np.array([0.08, 0.4, 0.7, 1.0]) * actor.height
    origins = (points[:, None] + np.outer(rises, [0, 0, 1])).reshape(-1, 3)
    origins[:, 2] = np.maximum(origins[:, 2], np.repeat(points[:, 2], len(rises)) + 0.06)
    free = space.distance(np.repeat(origins, 8, axis=0), np.tile(rays, (len(origins), 1)))
    return bool(free.min() > actor.radius)


def _clear(
    way: Way, actor: Actor, others: list[Way], actors: list[Actor], path: CameraPath, seconds: float
) -> bool:
    """Whether the actor meets neither the camera nor another actor."""
    for t in np.linspace(0, seconds, max(int(seconds * 5), 2)):
        here = np.array(way.at(t).position)
        if np.linalg.norm((path.at(t).pose[:3, 3] - here)[:2]) < actor.radius + 0.35:
            return False
        for other in others:
            apart = np.linalg.norm((np.array(other.at(t).position) - here)[:2])
            if apart < actor.radius + actors[other.actor].radius:
                return False
    return True


@dataclass(frozen=True)
class LightScript:
    """How a scene's light changes: kind is one of LIGHTING.

    lamp: the light that is switched or dips, -1 for all. low: its gain then.
    """

    kind: str
    lamp: int
    low: float
    when: float
    lasts: float
    rising: bool

    @staticmethod
    def sample(rng: np.random.Generator, lamps: int, seconds: float) -> LightScript:
        kind = str(rng.choice(list(LIGHTING), p=list(LIGHTING.values())))
        lamp = int(rng.integers(-1, lamps)) if lamps else -1
        low = float(rng.uniform(0.0, 0.5) if lamp >= 0 else rng.uniform(0.15, 0.6))
        when, lasts = rng.uniform(0.1, 0.9) * seconds, rng.uniform(0.1, 0.4) * seconds
        return LightScript(kind, lamp, low, float(when), float(lasts), bool(rng.random() < 0.5))

    def at(self, seconds: float, lamps: int) -> tuple[tuple[float, ...], float]:
        """Gain of each lamp, and of the ambient light (which follows the lamps in part)."""
        gain = self._gain(seconds)
        chosen = [gain if self.lamp in (-1, i) else 1.0 for i in range(lamps)]
        share = 1.0 if self.lamp == -1 else 1.0 / max(lamps, 1)
        return tuple(chosen), 1 + 0.8 * share * (gain - 1)

    def _gain(self, seconds: float) -> float:
        if self.kind == "drift":
            turn = 2 * np.pi * (seconds - self.when) / max(4 * self.lasts, 1.0)
            return float(self.low + (1 - self.low) * (0.5 + 0.5 * np.cos(turn)))
        if self.kind == "switch":
            return 1.0 if (seconds > self.when) == self.rising else self.low
        if self.kind == "dip":
            return self.low if self.when < seconds < self.when + self.lasts else 1.0
        return 1.0
