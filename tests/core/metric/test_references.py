"""Measurements laid beside a predicted frame: the right pixels, and nothing lost silently."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from dyfn_core.metric.references import (
    MOST_POINTS,
    ConeReference,
    DepthReference,
    PointReference,
)

SIZE = (48, 64)
CAMERA = np.array([[60.0, 0, 31.5], [0, 62.0, 23.5], [0, 0, 1]])


@dataclass
class View:
    points: np.ndarray
    depth: np.ndarray
    valid: np.ndarray
    camera_matrix: np.ndarray
    frame_id: str = ""


def view_of(depth: np.ndarray) -> View:
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(float)
    rays = np.stack([(u - 31.5) / 60, (v - 23.5) / 62, np.ones_like(u)], -1)
    depth = depth.astype(np.float32)
    return View(rays * depth[..., None], depth, np.isfinite(depth), CAMERA)


@pytest.fixture
def slanted() -> View:
    """Depth 1 at the left edge to 3 at the right."""
    return view_of(np.broadcast_to(np.linspace(1, 3, SIZE[1]), SIZE).copy())


def test_points_meet_the_pixel_that_they_project_onto(slanted: View) -> None:
    rows, columns = np.array([3, 20, 40]), np.array([5, 30, 60])
    metres = 2 * slanted.points[rows, columns]
    found = PointReference(metres).evidence(slanted, 1.5)
    np.testing.assert_allclose(found.predicted, slanted.depth[rows, columns])
    np.testing.assert_allclose(found.measured, 2 * slanted.depth[rows, columns], rtol=1e-6)
    assert (found.stamp, dict(found.dropped)) == (1.5, {})


def test_points_that_cannot_be_used_are_counted_by_reason(slanted: View) -> None:
    slanted.valid[20, 30] = False
    points = np.array(
        [
            [np.nan, 0, 1],
            [0, 0, np.inf],
            [0, 0, -2.0],
            [0, 0, 0.0],
            [5.0, 0, 1],
            2 * slanted.points[20, 30],
            2 * slanted.points[10, 10],
        ]
    )
    found = PointReference(points).evidence(slanted, 0.0)
    assert len(found.predicted) == 1
    assert found.dropped == {
        "missing": 2,
        "behind the camera": 2,
        "outside the image": 1,
        "no predicted depth": 1,
    }


def test_points_at_a_predicted_depth_edge_are_not_used() -> None:
    depth = np.full(SIZE, 1.0)
    depth[:, 32:] = 3.0
    view = view_of(depth)
    found = PointReference(view.points[20, [10, 31, 32, 50]]).evidence(view, 0.0)
    np.testing.assert_array_equal(found.predicted, [1.0, 3.0])
    assert found.dropped == {"at a depth edge": 2}


def test_no_points_and_no_valid_prediction_give_no_pairs(slanted: View) -> None:
    assert not len(PointReference(np.empty((0, 3))).evidence(slanted, 0.0).predicted)
    blind = view_of(np.full(SIZE, np.inf))
    blind.valid[:] = False
    found = PointReference(np.array([[0.0, 0.0, 1.0]])).evidence(blind, 0.0)
    assert found.dropped == {"no predicted depth": 1}


@pytest.mark.parametrize("shape", [SIZE, (12, 16), (96, 128), (30, 20)])
def test_depth_image_of_any_resolution_lies_over_the_whole_view(
    slanted: View, shape: tuple[int, int]
) -> None:
    columns = (np.arange(shape[1]) + 0.5) / shape[1] * SIZE[1] - 0.5
    depth = np.broadcast_to(5 * np.interp(columns, np.arange(64), slanted.depth[0]), shape).copy()
    depth[0, :3] = [np.nan, 0.0, -1.0]
    found = DepthReference(depth).evidence(slanted, 0.0)
    assert 0 < len(found.predicted) <= MOST_POINTS
    np.testing.assert_allclose(found.measured / found.predicted, 5, rtol=0.03)
    assert found.dropped["missing"] == 3
    total = len(found.predicted) + sum(found.dropped.values())
    assert total == depth.size


def test_sound_answers_to_the_near_part_of_the_cone_and_light_to_its_middle() -> None:
    depth = np.full(SIZE, 4.0)
    depth[14:34, 28:34] = 2.0
    view = view_of(depth)
    hit = np.array([0.0, 0.0, 3.0])
    sound = ConeReference(hit, np.radians(12), nearest=True).evidence(view, 0.0)
    light = ConeReference(hit, np.radians(12), nearest=False).evidence(view, 0.0)
    assert sound.measured == light.measured == pytest.approx(3.0)
    assert sound.predicted[0] == pytest.approx(2.0, rel=0.02)
    assert light.predicted[0] == pytest.approx(4.0, rel=0.03)


def test_cone_compares_distances_along_its_own_ray() -> None:
    """A wall at depth 2 is farther away, seen at an angle; and a beam of no width still hits."""
    view = view_of(np.full(SIZE, 2.0))
    direction = view.points[5, 60] / 2.0
    wall = 7.0 * direction
    found = ConeReference(wall, 0.0, nearest=False).evidence(view, 0.0)
    assert found.measured[0] / found.predicted[0] == pytest.approx(3.5, rel=0.03)


@pytest.mark.parametrize(
    ("hit", "reason"),
    [
        ([0, 0, -1.0], "behind the camera"),
        ([9.0, 0, 1.0], "outside the image"),
        ([0, 0, np.inf], "missing"),
        ([0, 0, 0.0], "missing"),
    ],
)
def test_cone_that_hits_nothing_visible_is_counted(
    slanted: View, hit: list[float], reason: str
) -> None:
    found = ConeReference(np.array(hit), 0.1, nearest=True).evidence(slanted, 0.0)
    assert not len(found.predicted)
    assert found.dropped == {reason: 1}


def test_measurements_out_of_bounds_are_counted_and_not_used(slanted: View) -> None:
    rows, columns = np.array([3, 20, 40, 30]), np.array([5, 30, 60, 50])
    metres = slanted.points[rows, columns] * np.array([1.0, 1e38, 1e6, 1e-3])[:, None]
    whole = PointReference(metres).evidence(slanted, 0.0)
    found = whole.within(0.01, 200.0)
    np.testing.assert_allclose(found.measured, slanted.depth[rows[:1], columns[:1]], rtol=1e-6)
    np.testing.assert_allclose(found.predicted, found.measured, rtol=1e-6)
    assert dict(found.dropped) == {
        "beyond reference_max_depth": 2,
        "nearer than reference_min_depth": 1,
    }
    assert found.middle == pytest.approx(2.0, rel=0.05)
