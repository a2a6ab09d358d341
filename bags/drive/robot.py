"""A robot with two driven wheels: how it drives, what its odometry says, where its camera is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dyfn_worlds.camera.cameras import pose_at

RATE = 120.0  # simulated steps a second
ACCELERATION = 0.55  # metres a second squared
TURNING = 2.2  # radians a second squared
FASTEST_TURN = 0.75  # radians a second: 43 degrees
LOOKAHEAD = 0.45  # metres
ARRIVED = 0.015  # metres
HEIGHT, FORWARD, PITCH = 0.9, 0.12, -9.0  # of the camera: metres, metres, degrees


@dataclass(frozen=True)
class Leg:
    """One part of a drive: along points (x, y), or a turn on the spot to a heading in degrees, or
    a pause in seconds. speed: metres a second."""

    points: Sequence[tuple[float, float]] = ()
    heading: float | None = None
    pause: float = 0.0
    speed: float = 0.65


@dataclass
class Drive:
    """Where the robot's base was, RATE times a second. states: N x 3 of x, y, heading (radians,
    unwrapped); travelled: N metres."""

    states: np.ndarray
    travelled: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        steps = np.linalg.norm(np.diff(self.states[:, :2], axis=0), axis=1)
        self.travelled = np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def seconds(self) -> float:
        return (len(self.states) - 1) / RATE

    def at(self, seconds: float) -> np.ndarray:
        """x, y, heading at a time."""
        times = np.arange(len(self.states)) / RATE
        return np.array([np.interp(seconds, times, self.states[:, k]) for k in range(3)])

    def reached(self, point: tuple[float, float]) -> float:
        """Metres travelled when the base is nearest to a point."""
        nearest = np.argmin(np.linalg.norm(self.states[:, :2] - point, axis=1))
        return float(self.travelled[nearest])

    def distance(self, seconds: float) -> float:
        """Metres travelled until then."""
        return float(np.interp(seconds, np.arange(len(self.states)) / RATE, self.travelled))


def drive(start: tuple[float, float, float], legs: Sequence[Leg]) -> Drive:
    """Simulates the legs from a start (x, y, degrees)."""
    state = np.array([start[0], start[1], np.radians(start[2])])
    states = [state]
    for leg in legs:
        if leg.points:
            part = _follow(state, leg)
        elif leg.heading is not None:
            part = _turned(state, np.radians(leg.heading))
        else:
            part = [state] * round(leg.pause * RATE)
        states += part
        state = states[-1]
    return Drive(np.array(states))


def _follow(state: np.ndarray, leg: Leg) -> list[np.ndarray]:
    """Pure pursuit of a polyline, with limits on acceleration and turning; stops at its end."""
    way = _dense(np.array([state[:2], *leg.points]))
    states, speed, turn, nearest = [], 0.0, 0.0, 0
    for _ in range(round(120 * RATE)):
        ahead = way[nearest : nearest + 200]
        nearest += int(np.argmin(np.linalg.norm(ahead - state[:2], axis=1)))
        left = float(np.linalg.norm(way[-1] - state[:2])) if nearest > len(way) - 60 else 9.0
        if left < ARRIVED or (nearest == len(way) - 1 and speed < 0.03):
            return states
        aim = way[min(nearest + round(LOOKAHEAD * 100), len(way) - 1)] - state[:2]
        bearing = (np.arctan2(aim[1], aim[0]) - state[2] + np.pi) % (2 * np.pi) - np.pi
        curve = 2 * np.sin(bearing) / max(float(np.linalg.norm(aim)), 0.3)
        most = min(leg.speed, 0.8 * FASTEST_TURN / max(abs(curve), 1e-3))
        most = min(max(most, 0.12), np.sqrt(2 * 0.8 * ACCELERATION * left) + 0.02)
        speed += float(np.clip(most - speed, -1.6 * ACCELERATION / RATE, ACCELERATION / RATE))
        wanted = float(np.clip(speed * curve, -FASTEST_TURN, FASTEST_TURN))
        turn += float(np.clip(wanted - turn, -TURNING / RATE, TURNING / RATE))
        state = _stepped(state, speed, turn)
        states.append(state)
    raise ValueError(f"the robot does not arrive at {leg.points[-1]}")


def _turned(state: np.ndarray, heading: float) -> list[np.ndarray]:
    states, turn = [], 0.0
    while True:
        left = (heading - state[2] + np.pi) % (2 * np.pi) - np.pi
        if abs(left) < 2e-3 and abs(turn) < 0.05:
            return states
        most = min(FASTEST_TURN, np.sqrt(2 * 0.8 * TURNING * abs(left)))
        turn += float(np.clip(np.sign(left) * most - turn, -TURNING / RATE, TURNING / RATE))
        state = _stepped(state, 0.0, turn)
        states.append(state)


def _stepped(state: np.ndarray, speed: float, turn: float) -> np.ndarray:
    middle = state[2] + 0.5 * turn / RATE
    step = np.array([np.cos(middle) * speed, np.sin(middle) * speed, turn]) / RATE
    moved: np.ndarray = state + step
    return moved


def _dense(points: np.ndarray) -> np.ndarray:
    """A point every centimetre of a polyline."""
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0, arc[-1], max(int(arc[-1] * 100), 2))
    return np.stack([np.interp(at, arc, points[:, k]) for k in range(2)], axis=1)


def planar_pose(state: np.ndarray) -> np.ndarray:
    """x, y, heading -> 4 x 4 of the base (x forward, y left, z up) in the floor's frame."""
    c, s = np.cos(state[2]), np.sin(state[2])
    pose = np.eye(4)
    pose[:2, :2], pose[:2, 3] = [[c, -s], [s, c]], state[:2]
    return pose


def mounting() -> np.ndarray:
    """4 x 4: the camera's optical frame in the base's."""
    return pose_at(np.array([FORWARD, 0.0, HEIGHT]), 0.0, np.radians(PITCH), 0.0)


class Floor:
    """How the base rocks on an uneven floor: degrees of pitch and roll over the distance, and
    bumps where it rolls over a strip in a doorway."""

    def __init__(self, rng: np.random.Generator, strips: Sequence[float], size: float = 0.09):
        self._waves = 1 / rng.uniform(0.12, 1.2, 9)
        self._phase, self._size = rng.uniform(0, 2 * np.pi, (2, 9)), size
        self._strips = strips

    def tilt(self, travelled: float) -> np.ndarray:
        """3 x 3 rotation."""
        waves = np.sin(2 * np.pi * self._waves * travelled + self._phase).sum(axis=1)
        pitch, roll = np.radians(self._size * waves / np.sqrt(4.5))
        for strip in self._strips:  # the front wheels go over it, then the rear ones
            for wheel, sign in ((0.12, 1), (-0.12, -1)):
                bump = np.exp(-(((travelled - strip + wheel) / 0.03) ** 2))
                pitch += sign * np.radians(0.5) * bump
        c, s = np.cos(pitch), np.sin(pitch)
        up = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])  # positive: the nose goes up
        c, s = np.cos(roll), np.sin(roll)
        return up @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
