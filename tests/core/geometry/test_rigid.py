"""Rigid motions: their inverse, their size, and what lies between two of them."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_core.geometry.rigid import between, inverse, quaternion_rotation, rigid, size_of


def turned(degrees: float, *place: float) -> np.ndarray:
    """About z."""
    half = np.radians(degrees) / 2
    return rigid(quaternion_rotation(np.cos(half), 0, 0, np.sin(half)), np.array(place))


def test_the_way_between_two_poses_has_one_angular_velocity() -> None:
    found = between(turned(10, 0, 0, 0), turned(50, 4, -2, 8), 0.25)
    np.testing.assert_allclose(found, turned(20, 1, -0.5, 2), atol=1e-12)


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 30.0, 179.999, 180.0])
def test_the_size_of_a_motion_is_its_angle_and_its_length(degrees: float) -> None:
    angle, length = size_of(turned(degrees, 3, 0, 4))
    assert angle == pytest.approx(np.radians(degrees), rel=1e-9, abs=1e-12)
    assert length == pytest.approx(5)


def test_an_inverse_undoes_the_motion() -> None:
    pose = turned(35, 1, 2, 3)
    np.testing.assert_allclose(inverse(pose) @ pose, np.eye(4), atol=1e-12)
