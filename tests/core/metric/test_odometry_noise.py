"""The made odometry has the errors that it is asked for."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from dyfn_core.metric.odometry_noise import OdometryNoise, noisy_poses
from tests.support.textured_plane import pose_at

STEP = 0.25  # metres
POSES = [pose_at((STEP * i, 0.0, 0.0), (0.0, 0.01 * i, 0.0)) for i in range(2001)]


def steps(poses: list[np.ndarray]) -> np.ndarray:
    return np.stack([np.linalg.inv(a) @ b for a, b in pairwise(poses)])


def test_errors_of_steps_have_the_stated_size() -> None:
    noise = OdometryNoise(scale=0.02, distance=0.01, rotation=0.2, seed=5)
    true, made = steps(POSES), steps(noisy_poses(POSES, noise))
    moved = made[:, :3, 3] - 1.02 * true[:, :3, 3]
    turned = np.stack(
        [cv2.Rodrigues(a[:3, :3].T @ b[:3, :3])[0].ravel() for a, b in zip(true, made, strict=True)]
    )
    # 6000 draws fix a standard deviation within 0.9%, and a mean within 1.3% of it
    assert moved.std() == pytest.approx(0.01 * STEP, rel=0.04)
    assert np.degrees(turned.std()) == pytest.approx(0.2 * np.sqrt(STEP), rel=0.04)
    assert abs(moved.mean()) < 0.06 * 0.01 * STEP
    assert np.linalg.norm(made[:, :3, 3], axis=1).mean() == pytest.approx(1.02 * STEP, rel=0.002)


def test_seed_decides_the_draws_and_the_first_pose_is_true() -> None:
    one, same, other = (noisy_poses(POSES[:20], OdometryNoise(seed=s)) for s in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.allclose(one[1:], other[1:])
    assert np.array_equal(one[0], POSES[0])


def test_without_errors_the_poses_are_the_true_ones() -> None:
    made = noisy_poses(POSES[:50], OdometryNoise(0.0, 0.0, 0.0))
    np.testing.assert_allclose(made, POSES[:50], atol=1e-12)


def test_planar_noise_stays_on_the_floor() -> None:
    floor = []
    for i in range(400):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, 0.01 * i]))[0]
        pose[:2, 3] = STEP * i * np.cos(0.005 * i), STEP * i * np.sin(0.005 * i)
        floor.append(pose)
    made = np.array(noisy_poses(floor, OdometryNoise(seed=2, planar=True)))
    assert np.abs(made[:, 2, 3]).max() == 0.0
    np.testing.assert_allclose(made[:, 2, :3], np.tile([0, 0, 1], (400, 1)), atol=1e-12)
    turned = [np.arctan2(p[1, 0], p[0, 0]) - np.arctan2(q[1, 0], q[0, 0])
              for p, q in zip(made, floor, strict=True)]  # fmt: skip
    assert np.degrees(np.abs(np.unwrap(turned)).max()) > 0.5
