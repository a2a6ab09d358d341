"""Odometry as a wheeled robot measures it, made from true poses: for tests and benchmarks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

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
    """

    scale: float = 0.02
    distance: float = 0.01
    rotation: float = 0.2
    seed: int = 0


def noisy_poses(poses: Sequence[np.ndarray], noise: OdometryNoise) -> list[np.ndarray]:
    """Camera-to-world poses as an odometry with these errors would report them.

    Args:
        poses: true ones, 4 x 4 each, metres, in the order of time.
        noise: see OdometryNoise.

    Returns:
        As many poses; the first one is the true one.
    """
    draw = np.random.default_rng(noise.seed)
    found = [np.array(poses[0], np.float64)]
    for before, now in pairwise(poses):
        step = np.linalg.inv(before) @ now
        length = float(np.linalg.norm(step[:3, 3]))
        step[:3, 3] *= 1 + noise.scale
        step[:3, 3] += draw.normal(0, noise.distance * length, 3)
        turn = draw.normal(0, math.radians(noise.rotation) * math.sqrt(length), 3)
        step[:3, :3] = step[:3, :3] @ cv2.Rodrigues(turn)[0]
        found.append(found[-1] @ step)
    return found
