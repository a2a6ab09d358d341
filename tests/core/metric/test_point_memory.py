"""Points that are carried from picture to picture by the poses."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_core.metric.motion import MotionPoints
from dyfn_core.metric.point_memory import (
    MemoryOptions,
    PointMemory,
    chosen,
    recall,
    remember,
    unhidden,
)
from tests.support.textured_plane import CAMERA, SIZE, pose_at

OPTIONS = MemoryOptions()
THERE = pose_at((0.4, -0.2, 0.3), (0.02, -0.05, 0.01))


def seen(ids: list[int], depth: float = 3.0, sigma: float = 0.05) -> MotionPoints:
    number = len(ids)
    x = 40.0 + 5 * np.arange(number)
    pixels = np.column_stack([x, 60 + 0.3 * x])
    sigmas = np.full(number, sigma)
    return MotionPoints(
        np.array(ids, np.int64), pixels, np.full(number, depth), 0.5 * sigmas, sigmas, 0.4, number
    )


NOTHING = MotionPoints()


def kept(points: MotionPoints, stamp: float = 0.0, options: MemoryOptions = OPTIONS) -> PointMemory:
    return remember(PointMemory(), points, CAMERA, np.eye(4), stamp, options)


def test_points_are_where_the_poses_say() -> None:
    points = seen(list(range(20)))
    found = recall(kept(points), NOTHING, CAMERA, THERE, 0.5, SIZE, OPTIONS)
    rays = np.column_stack([(points.pixels - CAMERA[:2, 2]) / CAMERA[0, 0], np.ones(20)])
    here = np.linalg.inv(THERE) @ np.vstack([rays.T * 3.0, np.ones(20)])
    np.testing.assert_allclose(found.depth, here[2], rtol=1e-12)
    wanted = (here[:2] / here[2] * CAMERA[0, 0]).T + CAMERA[:2, 2]
    np.testing.assert_allclose(found.pixels, wanted, rtol=1e-9)


def test_sigma_grows_with_age_until_a_point_is_forgotten() -> None:
    memory = kept(seen([1, 2, 3]))
    for age in (0.0, 1.0, 2.9):
        found = recall(memory, NOTHING, CAMERA, np.eye(4), age, SIZE, OPTIONS)
        np.testing.assert_allclose(found.sigma, np.hypot(0.05, 0.11 * np.sqrt(age)))
        np.testing.assert_allclose(found.sigma_pixels, 0.025)
    assert not len(recall(memory, NOTHING, CAMERA, np.eye(4), 3.0, SIZE, OPTIONS).ids)
    assert not len(remember(memory, NOTHING, CAMERA, np.eye(4), 3.0, OPTIONS).ids)


def test_track_that_is_seen_again_replaces_its_point() -> None:
    memory = remember(kept(seen([1, 2, 3])), seen([2], 5.0), CAMERA, np.eye(4), 1.0, OPTIONS)
    assert memory.ids.tolist() == [1, 2, 3]
    assert memory.points[:, 2].tolist() == [3.0, 5.0, 3.0]
    found = recall(memory, seen([3], 7.0), CAMERA, np.eye(4), 1.0, SIZE, OPTIONS)
    assert found.ids.tolist() == [3, 1, 2]
    assert found.depth.tolist() == pytest.approx([7.0, 3.0, 5.0])


def test_uncertain_points_are_not_remembered() -> None:
    assert not len(kept(seen([1, 2], sigma=0.2)).ids)


def test_points_that_something_hides_by_now_are_left_out() -> None:
    """A remembered point behind the prediction; not one before it, unknown, or of this frame."""
    found = recall(kept(seen([1, 2, 3, 4])), seen([9], 5.0), CAMERA, np.eye(4), 1.0, SIZE, OPTIONS)
    residuals = np.array([2.0, 0.71, 0.69, -2.0, np.nan])
    assert chosen(found, unhidden(residuals, 1, OPTIONS)).ids.tolist() == [9, 2, 3, 4]


def test_points_behind_and_beside_the_picture_are_left_out() -> None:
    memory = kept(seen([1, 2, 3]))
    ahead, turned = pose_at((0, 0, 3.0), (0, 0, 0)), pose_at((0, 0, 0), (0, 1.5, 0))
    for pose in (ahead, turned):
        assert not len(recall(memory, NOTHING, CAMERA, pose, 0.1, SIZE, OPTIONS).ids)


def test_number_is_bounded_and_the_oldest_go_first() -> None:
    options = MemoryOptions(most=5)
    memory = kept(seen([1, 2, 3, 4]), options=options)
    memory = remember(memory, seen([5, 6, 7]), CAMERA, np.eye(4), 1.0, options)
    assert len(memory.ids) == 5
    assert {5, 6, 7} <= set(memory.ids.tolist())


def test_time_that_goes_back_forgets_the_future() -> None:
    memory = kept(seen([1, 2]), stamp=10.0)
    assert not len(recall(memory, NOTHING, CAMERA, np.eye(4), 9.0, SIZE, OPTIONS).ids)
    assert not len(remember(memory, NOTHING, CAMERA, np.eye(4), 9.0, OPTIONS).ids)


def test_nothing_is_remembered_for_no_time() -> None:
    options = MemoryOptions(seconds=0.0)
    memory = kept(seen([1, 2]), options=options)
    assert not len(recall(memory, NOTHING, CAMERA, np.eye(4), 0.0, SIZE, options).ids)
