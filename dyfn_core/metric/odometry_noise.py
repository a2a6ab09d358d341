"""Odometry as a wheeled robot measures it, made from true poses: for tests and benchmarks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class OdometryNoise:
    """Errors of an odometry.

    Attributes:
        scale: constant error of distances (0.02: 2%).
        distance: random walk of the translation, a share of the distance moved (0.01: 1%).
        rotation: random walk of the orientation, degrees per square root of a metre moved.
        seed: of the random walk.
        planar: the poses are of a base on a level floor (x forward, y left, z up): the random walks
            are within the floor's plane, and turns are about its normal.
    """

    scale: float = 0.02
    distance: float = 0.01
    rotation: float = 0.2
    seed: int = 0
    planar: bool = False


class NoisyOdometry:
    """Takes true poses one at a time and gives those that an odometry would report."""

    def __init__(self, noise: OdometryNoise) -> None:
        """noise: See OdometryNoise."""
        self._noise = noise
        self._draw = np.random.default_rng(noise.seed)
        self._true: np.ndarray | None = None
        self._made: np.ndarray = np.eye(4)

    def push(self, pose: np.ndarray) -> np.ndarray:
        """The reported pose.

        Args:
            pose: True one, 4 x 4 camera to world, metres, in the order of time.

        Returns:
            4 x 4; the first one is the true one.
        """
        if self._true is None:
            self._made = np.array(pose, np.float64)
        else:
            self._made = self._made @ self._step(np.linalg.inv(self._true) @ pose)
        self._true = np.array(pose, np.float64)
        return np.array(self._made)

    def _step(self, step: np.ndarray) -> np.ndarray:
        noise, length = self._noise, float(np.linalg.norm(step[:3, 3]))
        step[:3, 3] *= 1 + noise.scale
        walk = self._draw.normal(0, noise.distance * length, 3)
        turn = self._draw.normal(0, math.radians(noise.rotation) * math.sqrt(length), 3)
        if noise.planar:
            walk[2], turn[:2] = 0.0, 0.0
        step[:3, 3] += walk
        step[:3, :3] = step[:3, :3] @ cv2.Rodrigues(turn)[0]
        return step


def noisy_poses(poses: Sequence[np.ndarray], noise: OdometryNoise) -> list[np.ndarray]:
    """Camera-to-world poses as an odometry with these errors would report them.

    Args:
        poses: True ones, 4 x 4 each, metres, in the order of time.
        noise: See OdometryNoise.

    Returns:
        As many poses; the first one is the true one.
    """
    odometry = NoisyOdometry(noise)
    return [odometry.push(pose) for pose in poses]


def parse_noise(text: str) -> OdometryNoise:
    """Read the errors of an odometry from a command line.

    Args:
        text: "SCALE,DISTANCE,ROTATION,SEED", see OdometryNoise; the seed may be left out.

    Raises:
        ValueError: Something else; the text says what was expected.

    Example:
        >>> parse_noise("0.02,0.01,0.2,1")
        OdometryNoise(scale=0.02, distance=0.01, rotation=0.2, seed=1)
    """
    parts = text.split(",")
    try:
        scale, distance, rotation = (float(part) for part in parts[:3])
        seed = int(parts[3]) if len(parts) == 4 else 0
    except ValueError:
        parts = []
    if not 3 <= len(parts) <= 4 or not all(map(math.isfinite, (scale, distance, rotation))):
        raise ValueError(f"expected SCALE,DISTANCE,ROTATION,SEED such as 0.02,0.01,0.2,0: {text!r}")
    if scale <= -1 or distance < 0 or rotation < 0 or seed < 0:
        raise ValueError(f"expected a scale above -1, and nothing else below 0: {text!r}")
    return OdometryNoise(scale, distance, rotation, seed)
