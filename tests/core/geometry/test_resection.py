"""The camera's motion from points and pixels: exact without noise, and with half of them wrong."""

from __future__ import annotations

import numpy as np

from dyfn_core.geometry.resection import resect
from tests.support.textured_plane import pose_at

FOCAL = 250.0


def moved_points(count: int) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(3)
    points = draw.uniform([-1, -1, 1.5], [1, 1, 5], (count, 3))
    motion = pose_at((0.3, -0.1, 0.2), (0.05, -0.2, 0.1))
    return points, points @ motion[:3, :3].T + motion[:3, 3]


def test_points_are_moved_into_the_new_frame() -> None:
    points, expected = moved_points(60)
    found = resect(points, expected[:, :2] / expected[:, 2:], FOCAL, 4.0)
    assert found is not None and found.inliers.all()
    np.testing.assert_allclose(found.points, expected, atol=0.02)


def test_half_of_the_pairs_may_be_wrong() -> None:
    points, expected = moved_points(200)
    rays = expected[:, :2] / expected[:, 2:]
    rays[100:] = np.random.default_rng(5).uniform(-0.6, 0.6, (100, 2))
    found = resect(points, rays, FOCAL, 4.0)
    assert found is not None
    assert found.inliers[:100].mean() > 0.95 and found.inliers[100:].mean() < 0.1
    np.testing.assert_allclose(found.points[:100], expected[:100], atol=0.06)


def test_too_few_pairs_or_none_that_agree_give_nothing() -> None:
    points, expected = moved_points(40)
    rays = expected[:, :2] / expected[:, 2:]
    assert resect(points[:7], rays[:7], FOCAL, 4.0) is None
    chance = np.random.default_rng(5).uniform(-2, 2, (40, 2))
    assert resect(points, chance, FOCAL, 0.5) is None
