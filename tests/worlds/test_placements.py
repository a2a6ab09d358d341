"""Where the cameras of views are put, and cameras that do not walk."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_worlds.camera.cameras import CameraLens, FreeSpace, placed_view
from dyfn_worlds.camera.choices import PLACEMENTS
from dyfn_worlds.camera.paths import random_path
from dyfn_worlds.rooms.rooms import furnished_room
from dyfn_worlds.scene.scene import Scene

LENS = CameraLens((0.8, 1.0))


@pytest.fixture(scope="module")
def room() -> Scene:
    return furnished_room(np.random.default_rng(3), None)


def _views(room: Scene, placement: str) -> list[np.ndarray]:
    space, rng = FreeSpace(room), np.random.default_rng(0)
    return [placed_view(space, rng, LENS, room.interests, placement).pose for _ in range(12)]


@pytest.mark.parametrize("placement", [p for p in PLACEMENTS if p != "above"])
def test_every_placement_is_in_free_space(room: Scene, placement: str) -> None:
    positions = np.stack([pose[:3, 3] for pose in _views(room, placement)])
    assert FreeSpace(room).clearance(positions).min() > 0.1


def test_steep_views_look_down(room: Scene) -> None:
    down = [-pose[2, 2] for pose in _views(room, "steep")]
    assert min(down) > np.sin(np.radians(28))


def test_low_views_are_at_a_wheeled_robot_s_height(room: Scene) -> None:
    space = FreeSpace(room)
    positions = np.stack([pose[:3, 3] for pose in _views(room, "low")])
    below = space.distance(positions, np.tile([0.0, 0, -1], (len(positions), 1)))
    assert below.max() < 0.51


def test_a_static_camera_does_not_move_and_a_turning_one_stays_where_it_is(room: Scene) -> None:
    space = FreeSpace(room)
    static = random_path(space, np.random.default_rng(1), LENS, 4.0, room.interests, "static")
    np.testing.assert_array_equal(static.at(0.3).pose, static.at(3.7).pose)
    turning = random_path(space, np.random.default_rng(1), LENS, 4.0, None, "turning")
    assert np.ptp(turning.positions, axis=0).max() < 0.1
    assert np.ptp(turning.angles[:, 0]) > np.radians(20)
