"""The ground plane: found when it is there, refused when it is not, a table is no floor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from dyfn_core.metric.ground import NoGroundError, fit_ground, ground_evidence, up_from_pitch

HEIGHT, WIDTH = 120, 160
CAMERA = np.array([[130.0, 0, 79.5], [0, 130.0, 59.5], [0, 0, 1]])


@dataclass
class View:
    points: np.ndarray
    depth: np.ndarray
    valid: np.ndarray
    camera_matrix: np.ndarray


def room(
    height: float, pitch: float, *, table: float = 0.0, noise: float = 0.0, floor: bool = True
) -> View:
    """A floor `height` below the camera, a wall 4 heights ahead, and maybe a table top."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    rays = np.stack([(u - 79.5) / 130, (v - 59.5) / 130, np.ones_like(u)], -1)
    up = up_from_pitch(pitch)
    ahead = np.array([0, -math.sin(pitch), math.cos(pitch)])
    depth = 4 * height / np.maximum(rays @ ahead, 1e-9)
    planes = [(height, slice(None))] if floor else []
    if table:
        planes.append((table, slice(WIDTH // 3, 2 * WIDTH // 3)))
    for below, columns in planes:
        down = rays[:, columns] @ -up
        hit = np.where(down > 1e-6, below / np.maximum(down, 1e-6), np.inf)
        depth[:, columns] = np.minimum(depth[:, columns], hit)
    depth *= np.exp(noise * np.random.default_rng(0).standard_normal(depth.shape))
    return View(rays * depth[..., None], depth.astype(np.float32), np.isfinite(depth), CAMERA)


@pytest.mark.parametrize("pitch", [0.0, 0.3, 0.8])
@pytest.mark.parametrize("height", [0.02, 1.0, 37.0])
def test_ground_is_found_in_any_unit_and_at_any_pitch(height: float, pitch: float) -> None:
    view = room(height, pitch)
    ground = fit_ground(view.points, view.valid, up_from_pitch(pitch))
    assert ground.distance == pytest.approx(height, rel=0.01)
    np.testing.assert_allclose(ground.normal, up_from_pitch(pitch), atol=0.02)


def test_a_table_is_not_taken_for_the_floor() -> None:
    view = room(1.0, 0.4, table=0.45)
    ground = fit_ground(view.points, view.valid, up_from_pitch(0.4))
    assert ground.distance == pytest.approx(1.0, rel=0.03)


def test_noise_and_a_wrong_gravity_prior_are_tolerated_to_a_degree() -> None:
    view = room(1.0, 0.4, noise=0.01)
    ground = fit_ground(view.points, view.valid, up_from_pitch(0.4 + math.radians(8)))
    assert ground.distance == pytest.approx(1.0, rel=0.05)
    assert 0 < ground.spread < 0.1
    with pytest.raises(NoGroundError):
        fit_ground(view.points, view.valid, up_from_pitch(0.4 + math.radians(40)))


def test_without_a_floor_there_is_no_ground() -> None:
    wall = room(1.0, 0.2, floor=False)
    with pytest.raises(NoGroundError, match="face up") as caught:
        fit_ground(wall.points, wall.valid, up_from_pitch(0.2))
    assert caught.value.kind == "nothing faces up"
    blind = room(1.0, 0.2)
    with pytest.raises(NoGroundError):
        fit_ground(blind.points, np.zeros_like(blind.valid), up_from_pitch(0.2))


def test_a_ceiling_is_no_ground() -> None:
    view = room(1.0, -0.4)
    above = view.points * [1, -1, 1]
    with pytest.raises(NoGroundError):
        fit_ground(above, view.valid, up_from_pitch(0.4))


def test_evidence_is_the_height_over_the_distance_or_a_counted_refusal() -> None:
    found = ground_evidence(room(0.5, 0.3), up_from_pitch(0.3), 1.2, 7.0)
    assert (found.stamp, found.measured.tolist()) == (7.0, [1.2])
    assert found.measured[0] / found.predicted[0] == pytest.approx(2.4, rel=0.02)
    nothing = ground_evidence(room(0.5, 0.3, floor=False), up_from_pitch(0.3), 1.2, 7.0)
    assert not len(nothing.predicted)
    assert nothing.dropped == {"no ground plane (nothing faces up)": 1}
