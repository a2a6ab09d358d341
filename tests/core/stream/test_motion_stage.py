"""metric_source odometry: a session that walks along a plane with a model of another unit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyfn_core.metric.references import PointReference
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.session import StreamSession
from tests.support.pinhole import FOV_X, PinholeModel
from tests.support.textured_plane import CAMERA, SIZE, plane_view, pose_at, texture, walk

UNIT = 3.0  # metres in one unit of the model
PERIOD = 0.5  # seconds
FOCAL = SIZE[1] / 2 / np.tan(np.radians(FOV_X / 2))
OWN_CAMERA = np.array([[FOCAL, 0, CAMERA[0, 2]], [0, FOCAL, CAMERA[1, 2]], [0, 0, 1]])
WHOLE = texture()


def frame_at(pose: np.ndarray, stamp: float) -> tuple[Frame, np.ndarray]:
    """Red says the depth to PinholeModel, green has the texture; the true depth in metres."""
    view = plane_view(pose, WHOLE, OWN_CAMERA)
    image = np.zeros((*SIZE, 3), np.uint8)
    image[..., 0] = np.round((view.depth / UNIT - 0.5) * 255)
    image[..., 1] = view.image[..., 1]
    return Frame(image, stamp, OWN_CAMERA, pose=pose), view.depth


@pytest.fixture(scope="module")
def walked() -> list[tuple[Frame, np.ndarray]]:
    return [frame_at(pose, PERIOD * i) for i, pose in enumerate(walk(18))]


def session_of(**options: Any) -> StreamSession:
    options = {"scene_cut_threshold": 0.0, **options}
    return StreamSession(PinholeModel(), StreamOptions(metric_source="odometry", **options))


def pushed(
    session: StreamSession, frames: list[tuple[Frame, np.ndarray]]
) -> list[Prediction[np.ndarray]]:
    return [session.push(frame) for frame, _ in frames]


def error(found: Prediction[np.ndarray], truth: np.ndarray) -> float:
    """Mean relative error of the valid pixels."""
    return float(np.abs(found.depth / truth - 1)[found.valid].mean())


def test_metres_follow_when_the_odometry_has_agreed(
    walked: list[tuple[Frame, np.ndarray]],
) -> None:
    session = session_of()
    found = pushed(session, walked)
    first = next(i for i, one in enumerate(found) if one.metric)
    assert 3.5 <= PERIOD * first <= 5.0
    for one, (_, truth) in zip(found[:first], walked, strict=False):
        assert not one.valid.any()
        assert one.withheld is not None and one.withheld.all()
        assert one.aligned_quantity[1].all()
        assert error(replace(one, mask=one.withheld), truth / UNIT) < 0.1
    for one, (_, truth) in zip(found[first:], walked[first:], strict=True):
        assert one.metric and one.valid.all()
        assert error(one, truth) < 0.06
        np.testing.assert_allclose(one.points[..., 2], one.depth, rtol=1e-5)
    assert session.scale.metric and not session.problems()
    assert session.metres_per_unit == pytest.approx(UNIT, rel=0.06)
    assert session.scale.map is not None
    assert session.scale.map.scale == pytest.approx(UNIT, rel=0.06)


def test_relative_depth_never_jumps_where_metres_begin(
    walked: list[tuple[Frame, np.ndarray]],
) -> None:
    found = pushed(session_of(until_metric="relative"), walked)
    assert {one.metric for one in found} == {False, True}
    steady = [float(np.median(one.aligned_quantity[0])) for one in found]
    truth = [float(np.median(depth)) for _, depth in walked]
    steps = np.diff(np.log(steady)) - np.diff(np.log(truth))
    assert np.abs(steps).max() < 0.05
    assert all(one.unit == pytest.approx(UNIT, rel=0.06) for one in found if one.metric)


def test_the_scale_outlives_a_reset_with_a_warning(
    walked: list[tuple[Frame, np.ndarray]],
) -> None:
    session = session_of()
    pushed(session, walked[:12])
    certain = session.scale.spread
    session.request_reset()
    found = session.push(walked[12][0])
    assert found.reset == "requested" and found.metric
    assert error(found, walked[12][1]) < 0.06
    assert session.scale.kept and session.scale.spread > certain + 0.1
    assert "kept from before a reset (requested)" in session.problems()[0]
    pushed(session, walked[13:])
    assert not session.problems() and session.scale.spread < 0.2


def test_the_scale_may_be_withheld_after_a_reset(
    walked: list[tuple[Frame, np.ndarray]],
) -> None:
    session = session_of(after_reset="withhold")
    pushed(session, walked[:12])
    session.request_reset()
    assert not session.push(walked[12][0]).metric
    assert session.metres_per_unit is None


def test_a_loaded_state_goes_on_with_the_same_bytes(
    walked: list[tuple[Frame, np.ndarray]], tmp_path: Path
) -> None:
    session, other = session_of(), session_of()
    pushed(session, walked[:11])
    session.save(str(tmp_path / "s"))
    other.load(str(tmp_path / "s"))
    for one, two in zip(pushed(session, walked[11:]), pushed(other, walked[11:]), strict=True):
        np.testing.assert_array_equal(one.depth, two.depth)
        assert one.metric and two.metric


def test_without_poses_the_metres_stay_and_the_reason_is_said(
    walked: list[tuple[Frame, np.ndarray]],
) -> None:
    session = session_of()
    pushed(session, walked[:12])
    lost = [(replace(frame, pose=None), truth) for frame, truth in walked[12:]]
    found = pushed(session, lost)
    assert all(one.metric for one in found)
    assert error(found[-1], walked[-1][1]) < 0.08
    assert session.problems() == ["odometry: no pose of the camera"]
    assert session.unused_references["no pose of the camera"] == len(lost)
    assert session.scale.age == pytest.approx(PERIOD * len(lost))


def test_poses_that_contradict_the_pictures_give_no_metres() -> None:
    """The odometry says forward, the pictures say sideways."""
    frames = [frame_at(pose, PERIOD * i)[0] for i, pose in enumerate(walk(16))]
    session = session_of()
    wrong = [pose_at((0.0, 0.0, 0.1 * i), (0.0, 0.0, 0.0)) for i in range(16)]
    found = [session.push(replace(f, pose=p)) for f, p in zip(frames, wrong, strict=True)]
    assert not any(one.metric for one in found)
    assert session.unused_references["contradicts the pictures"] >= 8
    assert "contradicts the pictures: reprojection error" in session.problems()[0]


def test_a_calibration_that_is_asked_for_counts_more(
    walked: list[tuple[Frame, np.ndarray]],
) -> None:
    """What is known is less certain afterwards, and the metres go on."""
    session, asked = session_of(), session_of()
    pushed(session, walked[:12])
    pushed(asked, walked[:12])
    assert "by odometry" in asked.request_calibration()
    one, other = session.push(walked[12][0]), asked.push(walked[12][0])
    assert one.metric and other.metric
    assert asked.scale.spread > session.scale.spread
    assert error(pushed(asked, walked[13:])[-1], walked[-1][1]) < 0.08


def test_an_odometry_in_no_metres_gives_no_metres(
    walked: list[tuple[Frame, np.ndarray]],
) -> None:
    session = session_of()
    for frame, _ in walked:
        assert frame.pose is not None
        pose = frame.pose.copy()
        pose[:3, 3] *= 1e4
        assert not session.push(replace(frame, pose=pose)).metric
    assert session.unused_references["implausible scale"] >= 1
    assert "implausible scale" in session.problems()[0]


def test_unknown_intrinsics_and_stamps(walked: list[tuple[Frame, np.ndarray]]) -> None:
    session = session_of()
    frame = walked[0][0]
    found = session.push(replace(frame, camera_matrix=None))
    assert not found.metric and not found.valid.any()
    assert session.problems() == ["odometry: the camera matrix is unknown"]
    with pytest.raises(ValueError, match="needs the frame's stamp, got None"):
        session.push(replace(frame, stamp=None))


def test_a_reference_is_counted_as_not_used() -> None:
    session = session_of()
    session.add_reference(0.0, PointReference(np.ones((3, 3))))
    assert session.unused_references == {"a reference, but metric_source is odometry": 1}


def test_the_field_can_be_switched_off(walked: list[tuple[Frame, np.ndarray]]) -> None:
    """Without it, a frame's depth is the model's times one number."""
    plain = StreamSession(PinholeModel(), StreamOptions(scene_cut_threshold=0.0))
    session, whole = session_of(scale_field=False), session_of()
    ratios = []
    for frame, _ in walked:
        depth = plain.push(frame).depth
        ratios.append([one.push(frame).depth / depth for one in (session, whole)])
    assert np.ptp(ratios[-1][0]) < 1e-5
    assert np.ptp(ratios[-1][1]) > 1e-3


def test_an_image_is_pushed_with_its_pose(walked: list[tuple[Frame, np.ndarray]]) -> None:
    session, other = session_of(), session_of()
    for frame, _ in walked[:11]:
        one = session.push(frame)
        two = other.push(
            frame.image, frame.stamp, camera_matrix=frame.camera_matrix, pose=frame.pose
        )
        np.testing.assert_array_equal(one.depth, two.depth)
    assert one.metric and two.metric
    with pytest.raises(TypeError, match="of a Frame are its own"):
        session.push(walked[11][0], 3.0)
