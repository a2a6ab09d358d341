"""Poses are compared with the motion in the pictures: offset in time, axes, direction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dyfn_core.geometry.rigid import inverse
from dyfn_core.metric.pose_agreement import PAIRS, Agreement, PoseAgreement
from tests.support.rocking_camera import COUNT, SECOND, pictures, place
from tests.support.textured_plane import CAMERA, plane_view, pose_at, texture

Pose = Callable[[float], "np.ndarray | None"]  # of seconds


@pytest.fixture(scope="module")
def seen() -> PoseAgreement:
    made = PoseAgreement(COUNT)
    for stamp, image in pictures():
        made.push(image, stamp, CAMERA)
    return made


def judged(seen: PoseAgreement, pose: Pose) -> Agreement:
    found = seen.judge(lambda stamp: pose(stamp / SECOND))
    assert found is not None
    return found


def test_right_poses_agree(seen: PoseAgreement) -> None:
    found = judged(seen, place)
    assert found.offset is None and not found.far
    assert found.error < 0.3


@pytest.mark.parametrize("late", [-0.3, -0.06, 0.06, 0.21])
def test_an_offset_of_the_poses_stamps_is_found(seen: PoseAgreement, late: float) -> None:
    found = judged(seen, lambda seconds: place(seconds - late))
    assert found.offset == pytest.approx(late, abs=0.006)
    assert found.best < 0.3 < found.error and not found.far


def test_an_offset_of_less_than_an_exposure_is_none(seen: PoseAgreement) -> None:
    assert judged(seen, lambda seconds: place(seconds - 0.015)).offset is None


@pytest.mark.parametrize(
    "changed",
    [
        lambda pose: inverse(pose),
        lambda pose: pose @ np.diag([1.0, -1, -1, 1]),  # y up, looking along -z
        lambda pose: pose @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
    ],
    ids=["world to camera", "OpenGL", "a body's axes"],
)
def test_poses_of_something_else_are_far(
    seen: PoseAgreement, changed: Callable[[np.ndarray], np.ndarray]
) -> None:
    found = judged(seen, lambda seconds: changed(place(seconds)))
    assert found.far and found.offset is None
    assert found.alone < 0.3


def test_at_a_constant_velocity_nothing_tells() -> None:
    def straight(seconds: float) -> np.ndarray:
        return pose_at((0.4 * seconds, 0, 0.1 * seconds), (0, -0.04 * seconds, 0))

    made, whole = PoseAgreement(30), texture()
    for index in range(30):
        made.push(plane_view(straight(index / 10), whole).image, index * SECOND // 10, CAMERA)
    found = judged(made, lambda seconds: straight(seconds - 0.3))
    assert found.offset is None and not found.far


def test_too_little_says_nothing(seen: PoseAgreement) -> None:
    assert seen.judge(lambda stamp: None) is None
    assert seen.judge(lambda stamp: place(1.0) if stamp < 1.5 * SECOND else None) is None
    still, unknown = PoseAgreement(COUNT), PoseAgreement(COUNT)
    for stamp, image in pictures():
        still.push(pictures()[0][1], stamp, CAMERA)
        unknown.push(image, stamp, None)
    for made in (still, unknown):
        assert made.judge(lambda stamp: place(stamp / SECOND)) is None


def test_the_number_of_pairs_does_not_grow() -> None:
    made = PoseAgreement(20 * COUNT)
    for turn in range(20):
        for stamp, image in pictures():
            made.push(image, stamp + turn * COUNT * SECOND // 10, CAMERA)
    assert PAIRS / 2 < len(made._pairs) <= 2 * PAIRS
