"""The step from frame to frame: a made walk along a plane, with a prediction of another unit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from dyfn_core.geometry.tracks import TrackOptions
from dyfn_core.metric.motion import MotionOptions, MotionPoints
from dyfn_core.metric.motion_scale import (
    MotionFrame,
    MotionScale,
    MotionScaleOptions,
    MotionScaleState,
    step,
)
from dyfn_core.metric.odometry_noise import OdometryNoise, noisy_poses
from tests.support.textured_plane import CAMERA, SIZE, plane_view, pose_at, texture, walk

OPTIONS = MotionScaleOptions(motion=MotionOptions(tracks=TrackOptions(most=250)))
UNIT = 2.5  # metres in one unit of the prediction
WHOLE = texture()
PERIOD = 0.5  # seconds


def frames(poses: list[np.ndarray]) -> list[MotionFrame]:
    """The prediction is the true depth in another unit."""
    found = []
    for index, pose in enumerate(poses):
        view = plane_view(pose, WHOLE)
        valid = np.ones(SIZE, bool)
        depth = view.depth / np.float32(UNIT)
        found.append(MotionFrame(view.image, PERIOD * index, CAMERA, pose, depth, valid))
    return found


@pytest.fixture(scope="module")
def walked() -> list[MotionFrame]:
    return frames(walk(16))


def run(
    stream: list[MotionFrame],
    options: MotionScaleOptions = OPTIONS,
    state: MotionScaleState | None = None,
) -> tuple[MotionScaleState, list[MotionScale]]:
    state, found = state or MotionScaleState(), []
    for frame in stream:
        state, scale = step(state, frame, options)
        found.append(scale)
    return state, found


def truth(frame: MotionFrame) -> np.ndarray:
    return frame.depth * np.float32(UNIT)


def metres(scale: MotionScale, depth: np.ndarray) -> np.ndarray:
    found = scale.metres(depth)
    assert found is not None
    return found


def test_walk_gives_metres(walked: list[MotionFrame]) -> None:
    _, found = run(walked)
    assert found[0].metric is None and found[0].metres(walked[0].depth) is None
    assert math.isnan(found[0].sigma)
    for scale, frame in list(zip(found, walked, strict=True))[-6:]:
        error = np.abs(metres(scale, frame.depth) / truth(frame) - 1)
        assert error.mean() < 0.03
        assert 0.0 < scale.sigma < 0.2
        assert not scale.problem


def test_noisy_odometry_gives_metres_within_its_error(walked: list[MotionFrame]) -> None:
    poses = noisy_poses([frame.pose for frame in walked], OdometryNoise(seed=3))
    noisy = [replace(frame, pose=pose) for frame, pose in zip(walked, poses, strict=True)]
    _, found = run(noisy)
    error = np.median(metres(found[-1], noisy[-1].depth) / truth(noisy[-1])) - 1
    assert abs(error) < 0.08


def test_metres_wait_until_the_odometry_has_agreed(walked: list[MotionFrame]) -> None:
    quick = [replace(frame, stamp=0.1 * i) for i, frame in enumerate(walked)]
    state, found = run(quick)
    assert state.unit is not None  # relative depth does not wait
    assert found[-1].metric is None
    assert "of the last frames, 75% needed: no metres" in found[-1].problem


def test_unit_is_locked_and_the_output_never_jumps(walked: list[MotionFrame]) -> None:
    """Drifting predictions: the correction follows, and begins with nothing at all."""
    drifting = [
        replace(frame, depth=frame.depth * np.float32(math.exp(0.02 * i)))
        for i, frame in enumerate(walked)
    ]
    options = replace(OPTIONS, field=None)
    _, found = run(drifting, options)
    first = next(i for i, scale in enumerate(found) if scale.measured is not None)
    assert all(scale.log_scale == 0.0 for scale in found[: first + 1])
    assert len({scale.metric for scale in found} - {None}) == 1
    logs = np.array([scale.log_scale for scale in found])
    assert np.abs(np.diff(logs)).max() < 0.06
    assert logs[-1] < -0.15  # followed
    middle = [float(np.median(s.relative(f.depth))) for s, f in zip(found, drifting, strict=True)]
    plain = [float(np.median(frame.depth)) for frame in drifting]
    assert middle[: first + 1] == pytest.approx(plain[: first + 1])
    for before, now in zip(middle[first:-1], middle[first + 1 :], strict=True):
        assert abs(math.log(now / before)) < 0.05


def test_field_mends_the_shape(walked: list[MotionFrame]) -> None:
    tilt = np.exp(np.linspace(-0.2, 0.2, SIZE[1], dtype=np.float32))[None]
    bent = [replace(frame, depth=frame.depth * tilt) for frame in walked]
    errors = []
    for options in (OPTIONS, replace(OPTIONS, field=None)):
        _, found = run(bent, options)
        assert found[-1].field.any() == (options.field is not None)
        errors.append(np.abs(metres(found[-1], bent[-1].depth) / truth(walked[-1]) - 1).mean())
    assert errors[0] < 0.5 * errors[1]
    assert errors[1] > 0.08


@pytest.mark.parametrize("rim", ["true", "in the prediction"])
def test_points_on_a_rim_do_not_bend_the_wall_behind(rim: str) -> None:
    """A box at 1 m before a wall at 2 m: the predicted box is smaller than the true one."""
    true, predicted = (np.full((120, 160), 2.0, np.float32) for _ in range(2))
    true[30:90, 40:120], predicted[32:88, 42:118] = 1.0, 1.0
    rows, columns = np.divmod(np.arange(30 * 40, 90 * 160, 37), 160)
    edge = np.array([[x, y] for y in (30.5, 89) for x in range(40, 120, 2)], float)
    pixels = np.concatenate([np.column_stack([columns, rows]), edge])
    depth = true[np.rint(pixels[:, 1]).astype(int), np.rint(pixels[:, 0]).astype(int)]
    sigma = np.full(len(pixels), 0.02)
    points = MotionPoints(
        np.arange(len(pixels)), pixels, depth.astype(np.float64), sigma, sigma, rms=0.3
    )
    image, valid = np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), bool)
    shown = true if rim == "true" else predicted
    frame = MotionFrame(image, 0.0, CAMERA, None, shown, valid, points=points)
    _, found = run([replace(frame, stamp=float(i)) for i in range(8)])
    wall = (true == 2.0) & (shown == 2.0)
    wall[24:96, 34:126] = False
    np.testing.assert_allclose(metres(found[-1], shown)[wall], 2.0, rtol=0.1)


def test_remembered_points_count(walked: list[MotionFrame]) -> None:
    _, with_memory = run(walked)
    nothing = replace(OPTIONS, memory=replace(OPTIONS.memory, seconds=0.0))
    _, without = run(walked, nothing)
    assert len(with_memory[-1].points.ids) > len(without[-1].points.ids)
    state, _ = run(walked)
    assert len(state.memory.ids) <= OPTIONS.memory.most


def test_lost_odometry_returns_to_the_stream_s_scale(walked: list[MotionFrame]) -> None:
    state, found = run(walked)
    lost = replace(walked[-1], pose=np.full((4, 4), np.nan))
    state, still = run([replace(lost, stamp=lost.stamp + 1.0 + i) for i in range(6)], state=state)
    assert state.scale is not None and state.unit is not None
    assert still[-1].measured is None
    assert still[-1].log_scale == pytest.approx(float(state.scale.mean[0]) - state.unit, abs=2e-3)
    assert still[-1].metric == found[-1].metric
    assert still[-1].sigma > found[-1].sigma
    assert not still[-1].field.any()


def test_from_the_start_without_parallax_there_are_no_metres() -> None:
    poses = [pose_at((0, 0, 0), (0, 0.02 * i, 0)) for i in range(6)]
    _, found = run(frames(poses))
    assert all(scale.metric is None and scale.log_scale == 0.0 for scale in found)
    assert not any(scale.field.any() for scale in found)


def test_pose_with_nan_is_told_and_does_not_stay(walked: list[MotionFrame]) -> None:
    broken = list(walked)
    broken[9] = replace(broken[9], pose=np.full((4, 4), np.nan))
    _, found = run(broken)
    assert found[9].problem == "the pose has values that are not finite"
    assert not len(found[9].points.ids)
    assert np.isfinite(found[9].relative(broken[9].depth)).all()
    assert np.abs(metres(found[-1], broken[-1].depth) / truth(broken[-1]) - 1).mean() < 0.03


def test_no_metres_from_an_odometry_that_contradicts_the_pictures(
    walked: list[MotionFrame],
) -> None:
    body = np.eye(4)
    body[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    wrong = [
        replace(frame, pose=frame.pose if i < 10 else frame.pose @ body)
        for i, frame in enumerate(walked)
    ]
    _, found = run(wrong)
    assert found[9].metric is not None and not found[9].problem
    assert any(s.problem.startswith("contradicts the pictures: reproj") for s in found[10:])
    assert found[-1].metric is None
    assert found[-1].problem
    assert np.isfinite(found[-1].relative(wrong[-1].depth)).all()


def test_depth_is_the_prediction_s_own_while_the_odometry_contradicts_most_pictures(
    walked: list[MotionFrame],
) -> None:
    """Bit for bit, and on the way there scale and field fade."""
    state, found = run(walked)
    assert found[-1].metric is not None
    there = [*walked, *walked[::-1]]
    aside = [pose_at((0.0, 0.0, 0.1 * i), (0.0, 0.0, 0.0)) for i in range(len(there))]
    shares = [1.0]
    for i, (frame, pose) in enumerate(zip(there, aside, strict=True)):
        wrong = replace(frame, pose=pose, stamp=walked[-1].stamp + 0.15 * (i + 1))
        state, scale = step(state, wrong, OPTIONS)
        assert state.scale is not None and state.unit is not None
        shares.append(scale.log_scale / (state.scale.log_scale - state.unit))
    assert min(shares) >= 0 and np.abs(np.diff(shares)).max() < 0.15
    assert shares[-1] == 0.0 and shares.count(1.0) < len(there) / 2
    assert scale.relative(wrong.depth).tobytes() == wrong.depth.tobytes()


def test_missing_predictions_stay_missing(walked: list[MotionFrame]) -> None:
    holed = []
    for frame in walked:
        valid = np.ones(SIZE, bool)
        valid[:60] = False
        holed.append(replace(frame, valid=valid, depth=np.where(valid, frame.depth, np.nan)))
    _, found = run(holed)
    last = metres(found[-1], holed[-1].depth)
    assert np.isnan(last[:60]).all()
    assert np.abs(last / truth(holed[-1]) - 1)[60:].mean() < 0.03


def test_same_input_gives_the_same_bytes_from_any_point_on(walked: list[MotionFrame]) -> None:
    middle, _ = run(walked[:8])
    kept = middle.memory.points.tobytes(), middle.scale, middle.stamp
    _, whole = run(walked)
    for _ in range(2):
        _, rest = run(walked[8:], state=middle)
        assert [scale.field.tobytes() for scale in rest] == [s.field.tobytes() for s in whole[8:]]
        assert [scale.log_scale for scale in rest] == [s.log_scale for s in whole[8:]]
    assert kept == (middle.memory.points.tobytes(), middle.scale, middle.stamp)


def test_later_frames_do_not_reach_back(walked: list[MotionFrame]) -> None:
    _, part = run(walked[:10])
    _, whole = run(walked)
    assert [scale.field.tobytes() for scale in part] == [s.field.tobytes() for s in whole[:10]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": np.ones((3, 4), np.float32)}, r"depth must have the image's size \(180, 240\)"),
        ({"valid": np.ones((3, 4), bool)}, "valid must have the image's size"),
        ({"image": np.zeros((*SIZE, 3), np.float32)}, "uint8"),
        ({"stamp": math.nan}, "stamp must be finite"),
    ],
)
def test_frames_that_do_not_fit_together_are_errors(
    walked: list[MotionFrame], change: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        step(MotionScaleState(), replace(walked[0], **change), OPTIONS)  # type: ignore[arg-type]
