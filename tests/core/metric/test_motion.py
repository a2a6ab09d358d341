"""Triangulated points and measured scales of a camera that moves along a made plane."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dyfn_core.geometry.tracks import TrackOptions
from dyfn_core.metric.motion import (
    MotionOptions,
    MotionPoints,
    MotionState,
    log_ratios,
    measure_scale,
    observe,
    step_variance,
    surface_doubt,
)
from tests.support.textured_plane import CAMERA, PlaneView, plane_view, pose_at, texture, walk

WHOLE = texture()
OPTIONS = MotionOptions(tracks=TrackOptions(most=250))
FRAMES = 12


def views(poses: list[np.ndarray]) -> list[PlaneView]:
    return [plane_view(pose, WHOLE) for pose in poses]


@pytest.fixture(scope="module")
def walked() -> list[PlaneView]:
    return views(walk(FRAMES))


def run(
    seen: list[PlaneView],
    camera: np.ndarray = CAMERA,
    poses: list[np.ndarray] | None = None,
) -> list[MotionPoints]:
    state, found = MotionState(), []
    for index, view in enumerate(seen):
        pose = view.pose if poses is None else poses[index]
        state, points = observe(state, view.image, camera, pose, OPTIONS)
        found.append(points)
    return found


def errors(points: MotionPoints, view: PlaneView) -> np.ndarray:
    """log(triangulated / true depth)."""
    return log_ratios(points, view.depth, np.ones(view.depth.shape, bool))


def test_points_have_the_plane_s_depth_in_metres(walked: list[PlaneView]) -> None:
    points = run(walked)[-1]
    found = errors(points, walked[-1])
    certain = found[points.sigma < 0.1]
    assert not points.problem
    assert len(certain) > 100
    assert abs(np.median(certain)) < 0.01
    assert np.quantile(np.abs(certain), 0.9) < 0.06
    assert points.rms < 0.3
    # Honest: no larger than stated. Made pictures have less noise than `pixel_noise`.
    assert np.mean(np.abs(found / points.sigma) > 2) < 0.05


def test_measured_scale_is_the_prediction_s(walked: list[PlaneView]) -> None:
    points, view = run(walked)[-1], walked[-1]
    ratios = log_ratios(points, view.depth / 2.5, np.ones(view.depth.shape, bool))
    found = measure_scale(points, ratios, view.depth.shape, OPTIONS)
    assert found is not None
    assert found.log_scale == pytest.approx(math.log(2.5), abs=0.02)
    assert 0.08**2 < found.variance < 0.2**2
    assert found.spread < 0.1


def made_points(number: int) -> MotionPoints:
    draw = np.random.default_rng(0)
    pixels = draw.uniform(0, 100, (number, 2))
    sigma = np.full(number, 0.05)
    return MotionPoints(np.arange(number), pixels, np.ones(number), sigma, sigma, 0.4, number)


def test_measurement_survives_outliers_and_refuses_disagreement() -> None:
    points, draw = made_points(200), np.random.default_rng(1)
    ratios = 0.4 + draw.normal(0, 0.05, 200)
    ratios[:50] = draw.uniform(0.5, 3, 50)
    found = measure_scale(points, ratios, (100, 100), OPTIONS)
    assert found is not None
    assert found.log_scale == pytest.approx(0.4, abs=0.04)
    assert measure_scale(points, draw.normal(0, 0.6, 200), (100, 100), OPTIONS) is None


@pytest.mark.parametrize(("usable", "measured"), [(7, False), (8, True)])
def test_measurement_needs_points(usable: int, measured: bool) -> None:
    ratios = np.full(20, np.nan)
    ratios[:usable] = 0.1
    found = measure_scale(made_points(20), ratios, (100, 100), OPTIONS)
    assert (found is not None) == measured


@pytest.mark.parametrize(("certain", "measured"), [(19, False), (20, True)])
def test_measurement_needs_a_share_of_the_points_to_be_certain(
    certain: int, measured: bool
) -> None:
    """The few that are certain where the camera has hardly moved are wrong together."""
    points = made_points(100)
    points.sigma[:] = np.where(np.arange(100) < certain, 0.1, 0.5)
    found = measure_scale(points, np.full(100, 0.1), (100, 100), OPTIONS)
    assert (found is not None) == measured


def test_crowded_corner_does_not_outvote_the_picture() -> None:
    points = made_points(200)
    points.pixels[:150] = [5.0, 5.0]
    ratios = np.where(np.arange(200) < 150, 0.5, 0.1)
    found = measure_scale(points, ratios, (100, 100), OPTIONS)
    assert found is not None
    assert found.log_scale == pytest.approx(0.1)


def test_ratio_is_unknown_without_a_prediction() -> None:
    points = made_points(3)
    points.pixels[:] = [[0, 0], [1, 0], [2, 0]]
    depth = np.array([[2.0, 4.0, 0.0]])
    found = log_ratios(points, depth, np.array([[True, False, True]]))
    np.testing.assert_allclose(found, [-math.log(2), np.nan, np.nan])


def test_point_at_an_edge_of_the_prediction_is_doubtful() -> None:
    """Left 1 m, right 2 m, a hole below: half of their distance in log depth, near the edge."""
    depth, valid = np.ones((100, 100), np.float32), np.ones((100, 100), bool)
    depth[:, 50:], valid[60:] = 2.0, False
    pixels = np.array([[20, 20], [48.6, 20], [51, 20], [53, 20], [20, 59], [20, 80]])
    edge = 0.5 * math.log(2)
    doubt = surface_doubt(pixels, depth, valid)
    np.testing.assert_allclose(doubt, [0, edge, edge, 0, 0, 0])
    assert surface_doubt(np.empty((0, 2)), depth, valid).shape == (0,)


STILL = [pose_at((0, 0, 0), (0, 0, 0))] * 6
TURNING = [pose_at((0, 0, 0), (0, 0.03 * i, 0)) for i in range(6)]


@pytest.mark.parametrize("poses", [STILL, TURNING, STILL[:1]], ids=["still", "turning", "one view"])
def test_without_parallax_there_is_no_measurement(poses: list[np.ndarray]) -> None:
    seen = views(poses)
    for points, view in zip(run(seen), seen, strict=True):
        ratios = errors(points, view)
        assert measure_scale(points, ratios, view.depth.shape, OPTIONS) is None
        assert not points.problem


def test_pose_that_is_no_pose_gives_no_points_and_the_tracks_go_on(
    walked: list[PlaneView],
) -> None:
    poses = [view.pose for view in walked]
    poses[6] = np.full((4, 4), np.nan)
    poses[7] = np.diag([1.0, 1.0, 2.0, 1.0])
    found = run(walked, poses=poses)
    assert found[6].problem == "the pose has values that are not finite"
    assert found[7].problem == "the pose is not a rotation and a translation"
    assert not len(found[6].depth) and not len(found[7].depth)
    assert found[6].tracked > 100
    after = errors(found[8], walked[8])
    assert len(after) > 50
    assert abs(np.median(after)) < 0.02


def test_wrong_shapes_are_errors(walked: list[PlaneView]) -> None:
    with pytest.raises(ValueError, match="pose must be 4 x 4"):
        observe(MotionState(), walked[0].image, CAMERA, np.eye(3), OPTIONS)
    with pytest.raises(ValueError, match="camera matrix"):
        observe(MotionState(), walked[0].image, np.zeros((3, 3)), np.eye(4), OPTIONS)


def contradicted(found: list[MotionPoints]) -> list[MotionPoints]:
    return [points for points in found if points.problem]


@pytest.mark.parametrize(
    "mounting",
    [
        pytest.param(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), id="axes of the body"),
        pytest.param(pose_at((0, 0, 0), (0, 0, np.pi / 2))[:3, :3], id="rolled"),
    ],
)
def test_pose_of_another_mounting_is_told(walked: list[PlaneView], mounting: np.ndarray) -> None:
    wrong = np.eye(4)
    wrong[:3, :3] = mounting
    found = contradicted(run(walked, poses=[view.pose @ wrong for view in walked]))
    assert found
    assert all(point.problem.startswith("contradicts the pictures: ") for point in found)
    assert all(not len(points.depth) for points in found)


def test_wrong_camera_matrix_is_told_when_the_camera_turns() -> None:
    poses = [
        pose_at((0.04 * i, 0, 0), (0.02 * np.sin(i), 0.05 * np.cos(1.3 * i), 0.1 * np.sin(i)))
        for i in range(FRAMES)
    ]
    seen = views(poses)
    camera = CAMERA.copy()
    camera[0, 0] = camera[1, 1] = 260.0  # of 200
    right, wrong = run(seen), run(seen, camera)
    assert not contradicted(right)
    assert np.nanmedian([p.rms for p in wrong]) > 3 * np.nanmedian([p.rms for p in right])
    assert len(contradicted(wrong)) >= FRAMES // 2


def test_jump_of_the_odometry_is_told_and_left_behind() -> None:
    seen = views(walk(16))
    jump = pose_at((2.0, -1.0, 0.5), (0, 0.5, 0))
    poses = [view.pose if i < 8 else jump @ view.pose for i, view in enumerate(seen)]
    found = run(seen, poses=poses)
    assert found[8].rms > OPTIONS.lost_rms and found[8].problem
    later = errors(found[-1], seen[-1])
    assert not found[-1].problem and len(later) > 50
    assert abs(np.median(later)) < 0.02


def test_same_input_gives_the_same_bytes_and_leaves_the_state_alone(
    walked: list[PlaneView],
) -> None:
    state = MotionState()
    for view in walked[:8]:
        state, _ = observe(state, view.image, CAMERA, view.pose, OPTIONS)
    kept = [view.tracks.points.tobytes() for view in state.views]
    one, two = (
        observe(state, walked[8].image, CAMERA, walked[8].pose, OPTIONS)[1] for _ in range(2)
    )
    assert one.depth.tobytes() == two.depth.tobytes()
    assert one.sigma.tobytes() == two.sigma.tobytes()
    assert kept == [view.tracks.points.tobytes() for view in state.views]


def test_memory_is_bounded() -> None:
    state = MotionState()
    for view in views(walk(30, step=0.08)):
        state, _ = observe(state, view.image, CAMERA, view.pose, OPTIONS)
    assert len(state.views) == OPTIONS.views
    assert state.tracker is not None
    assert len(state.tracker.tracks.ids) <= OPTIONS.tracks.most


def test_odometry_s_own_noise_grows_with_the_step() -> None:
    rotation, translation = step_variance(np.eye(4))
    assert math.degrees(math.sqrt(rotation)) == pytest.approx(0.1)
    assert math.sqrt(translation) == pytest.approx(1e-3)
    rotation, translation = step_variance(pose_at((3.0, 4.0, 0), (0, 0.5, 0)))
    assert math.sqrt(rotation) == pytest.approx(math.hypot(math.radians(0.1), 0.01))
    assert math.sqrt(translation) == pytest.approx(math.hypot(1e-3, 0.05))
