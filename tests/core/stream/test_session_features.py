"""A session's features without ROS: scene cuts, metres, saving and loading."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyfn_core.metric.references import PointReference
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.saving import StateError, path_for
from dyfn_core.stream.session import StreamSession
from tests.support.pinhole import FOV_X, PinholeModel
from tests.support.tiny_model import load_tiny


def session_of(**options: Any) -> StreamSession:
    return StreamSession(load_tiny(), StreamOptions(**options))


def push(session: StreamSession, image: np.ndarray, stamp: float) -> Prediction[np.ndarray]:
    return session.push(Frame(image, stamp))


def picture(seed: int, height: int = 36, width: int = 48) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(40, 216, (height // 4, width // 4, 3))
    return coarse.repeat(4, 0).repeat(4, 1).astype(np.uint8)


def test_a_scene_cut_resets_the_stream_and_is_off_at_zero() -> None:
    session, still = session_of(scene_cut_threshold=0.5), session_of(scene_cut_threshold=0.0)
    for seed, stamp in ((0, 0.0), (0, 0.1), (1, 0.2), (1, 0.3)):
        push(session, picture(seed), stamp)
        push(still, picture(seed), stamp)
    assert session.resets == {"scene cut": 1}
    assert not still.resets
    assert session.stream.memory.frames == 2


def test_reference_gives_metres_after_its_first_second_and_over_a_reset() -> None:
    session = session_of(metric_source="reference", scene_cut_threshold=0.0)
    relative = session_of(scene_cut_threshold=0.0)
    for step in range(13):
        stamp = 5 + step / 10
        plain = push(relative, picture(0), stamp)
        rows, columns = np.nonzero(plain.valid)
        points = 3.0 * plain.points[rows[::40], columns[::40]]
        session.add_reference(stamp, PointReference(points))
        found = push(session, picture(0), stamp)
        if step < 10:
            assert not found.metric
            assert not found.valid.any()
    assert found.metric
    np.testing.assert_allclose(found.depth[found.valid], 3 * plain.depth[found.valid], rtol=0.05)
    assert session.scale.map.scale == pytest.approx(3, rel=0.05)
    assert session.report()["scale: unit"] == "metres"
    certain = session.scale.spread
    session.request_reset()
    assert push(session, picture(0), 6.3).metric
    assert session.scale.spread == pytest.approx(np.hypot(certain, 0.2))
    assert session.problems() == ["scale: kept from before a reset: no measurement since"]
    session.options = replace(session.options, after_reset="withhold")
    session.request_reset()
    assert not push(session, picture(0), 6.4).metric
    assert "no measurement yet" in session.problems()[0]


def test_stale_and_early_measurements_are_counted() -> None:
    session = session_of(metric_source="reference", scene_cut_threshold=0.0)
    for stamp in (1.0, 50.0):
        session.add_reference(stamp, PointReference(np.ones((3, 3))))
    push(session, picture(0), 5.0)
    report = session.report()
    assert report["scale: not used, stale"] == "1"
    assert report["scale: not used, future-dated"] == "1"


def test_absurd_measurements_give_no_metres_and_are_said() -> None:
    """Points at 1e38 m, and a driver's 1e6 for no return, among good ones and alone."""
    session = session_of(
        metric_source="reference",
        calibration_seconds=0.2,
        frozen_after=0.0,  # the same picture again and again
        stabilize=False,
    )
    depth = push(session, picture(0), 0.0).depth[::4, ::4]
    rows, columns = np.mgrid[0 : 4 * depth.shape[0] : 4, 0 : 4 * depth.shape[1] : 4]
    camera = push(session, picture(0), 0.1).camera_matrix
    rays = np.stack(
        [
            (columns - camera[0, 2]) / camera[0, 0],
            (rows - camera[1, 2]) / camera[1, 1],
            np.ones(rows.shape),
        ],
        -1,
    )
    for index in range(2, 12):
        absurd = rays * (1e38 if index % 2 else 1e6)
        session.add_reference(index / 10, PointReference(absurd.reshape(-1, 3)))
        assert not push(session, picture(0), index / 10).metric
    assert session.unused_references["beyond reference_max_depth"] > 50
    assert "beyond reference_max_depth" in session.problems()[0]
    for index in range(12, 18):
        measured = rays * (2.5 * depth)[..., None]
        measured[::3] = rays[::3] * 1e38
        session.add_reference(index / 10, PointReference(measured.reshape(-1, 3)))
        push(session, picture(0), index / 10)
    assert session.scale.map is not None
    assert session.scale.map.scale == pytest.approx(2.5, rel=0.1)


def test_a_calibration_can_be_asked_for() -> None:
    """The former scale stays in force until the new one is known; no reset."""
    session = session_of(
        metric_source="reference", calibration_seconds=0.2, frozen_after=0.0, stabilize=False
    )
    first = push(session, picture(0), 0.0)
    camera, depth = first.camera_matrix, first.depth[::4, ::4]
    rows, columns = np.mgrid[0 : 4 * depth.shape[0] : 4, 0 : 4 * depth.shape[1] : 4]
    x, y = (columns - camera[0, 2]) / camera[0, 0], (rows - camera[1, 2]) / camera[1, 1]
    points = np.stack([x, y, np.ones_like(x)], -1) * depth[..., None]
    scales = []
    for index in range(1, 24):
        if index == 10:
            assert "until then 2 stays in force" in session.request_calibration()
        metres = (2.0 if index < 10 else 5.0) * points.reshape(-1, 3)
        session.add_reference(index / 10, PointReference(metres))
        push(session, picture(0), index / 10)
        scales.append(session.scale.map.scale if session.scale.map else 0.0)
        if index == 10:
            assert "kept from before the calibration" in session.problems()[0]
    assert scales[4:10] == pytest.approx([2.0] * 6, rel=0.02)
    assert scales[13:] == pytest.approx([5.0] * 10, rel=0.02)
    assert not session.problems() and not session.resets
    with pytest.raises(ValueError, match="metric_source is 'fixed', which measures nothing"):
        session_of(metric_source="fixed").request_calibration()


def test_the_camera_s_height_over_a_floor_gives_metres() -> None:
    """A floor 0.5 units below a level camera that is 1.5 m above it."""
    model = PinholeModel()
    height, width, low = 48, 64, 0.5
    focal = width / 2 / np.tan(np.radians(FOV_X / 2))
    rows = np.arange(height) - (height - 1) / 2
    depth = np.clip(low * focal / np.maximum(rows, 1e-3), 0.5, 1.5)
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.round((depth[:, None] - 0.5) * 255)
    options = StreamOptions(
        metric_source="camera_height",
        camera_height=1.5,
        blank_contrast=0.0,  # a floor and nothing on it
        calibration_points=2,
        calibration_seconds=0.01,
    )
    session = StreamSession(model, options)
    for index in range(4):
        found = push(session, image, index / 10)
    assert found.metric
    assert session.scale.map is not None
    assert session.scale.map.scale == pytest.approx(3.0, rel=0.1)


def test_loaded_state_gives_the_bytes_of_a_stream_that_never_stopped(tmp_path: Path) -> None:
    path = tmp_path / "s"
    session = session_of(metric_source="fixed", metric_scale=2.0)
    for seed in range(3):
        push(session, picture(0 if seed < 2 else 5), seed / 10)
    assert "saved 1 frames" in session.save(str(path))  # since the cut
    expected = [push(session, picture(5), 0.3 + step / 10).depth for step in range(3)]

    other = session_of(metric_source="fixed", metric_scale=2.0)
    other.load(str(path))
    found = [push(other, picture(5), 1000 + step / 10).depth for step in range(3)]
    for one, two in zip(expected, found, strict=True):
        np.testing.assert_array_equal(one, two)
    assert not other.resets


def test_a_frame_from_before_the_load_does_not_touch_the_loaded_state(tmp_path: Path) -> None:
    session = session_of(scene_cut_threshold=0.0)
    push(session, picture(0), 0.0)
    session.save(str(tmp_path / "s"))
    expected = push(session, picture(1), 0.1).depth
    before = session.asked
    session.load(str(tmp_path / "s"))
    session.push(Frame(picture(2), 0.2), asked=before)
    np.testing.assert_array_equal(push(session, picture(1), 0.3).depth, expected)


def test_a_calibration_and_the_last_image_come_back_with_the_state(tmp_path: Path) -> None:
    options = {"metric_source": "reference", "calibration_seconds": 0.1}
    session, path = session_of(**options), str(tmp_path / "s")
    relative = session_of()  # what a perfect sensor measures, up to scale
    for stamp in (0.0, 0.1, 0.2):
        points = push(relative, picture(0), stamp).points.reshape(-1, 3)
        points = 3.0 * points[np.isfinite(points).all(1)][::40]
        session.add_reference(stamp, PointReference(points))
        found = push(session, picture(0), stamp)
    assert found.metric
    session.save(path)
    other = session_of(**options)
    other.load(path)
    resumed = push(other, picture(0), 50.0)
    assert resumed.metric and resumed.reset is None
    np.testing.assert_array_equal(resumed.depth, push(session, picture(0), 0.3).depth)
    other.load(path)
    assert push(other, picture(5), 60.0).reset == "scene cut"


def test_state_that_does_not_fit_the_camera_is_refused(tmp_path: Path) -> None:
    session, path = session_of(), tmp_path / "s"
    with pytest.raises(StateError, match="nothing to save yet"):
        session.save(str(path))
    push(session, picture(0), 0.0)
    session.save(str(path))
    with pytest.raises(StateError, match="older file is kept"):
        session.save(str(tmp_path / "no" / "s"))
    with pytest.raises(StateError, match="state_file is empty"):
        session.save("")
    large = session_of()
    push(large, picture(0, 40, 60), 0.0)
    with pytest.raises(StateError, match="for images of 48 x 36 pixels, the camera's have 60 x 40"):
        large.load(str(path))
    with pytest.raises(StateError, match="saved with stabilize = True"):
        session_of(stabilize=False).load(str(path))
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(StateError, match="damaged"):
        session.load(str(path))


def test_cameras_that_share_a_path_have_files_of_their_own() -> None:
    assert path_for("/a/s.safetensors", "front", True) == "/a/s.front.safetensors"
    assert path_for("/a/s.safetensors", "front", False) == "/a/s.safetensors"
    assert path_for("", "front", True) == ""


def late_session(late: float, **options: Any) -> tuple[StreamSession, list[bool]]:
    """Every picture is measured, and the measurement comes `late` seconds after it."""
    session = session_of(metric_source="reference", scene_cut_threshold=0.0, **options)
    relative, waiting, metric = session_of(scene_cut_threshold=0.0), [], []
    for step in range(20):
        stamp = 5 + step / 10
        plain = push(relative, picture(step % 3), stamp)
        rows, columns = np.nonzero(plain.valid)
        waiting.append((stamp, 3.0 * plain.points[rows[::40], columns[::40]]))
        while waiting and waiting[0][0] <= stamp - late + 1e-6:
            when, points = waiting.pop(0)
            session.add_reference(when, PointReference(points))
        metric.append(push(session, picture(step % 3), stamp).metric)
    return session, metric


def test_measurements_that_come_after_their_image_count_with_its_prediction() -> None:
    """The pictures differ, so that another frame's prediction would give another scale."""
    at_once, metric = late_session(0.0, reference_tolerance=0.02)
    late, metric_late = late_session(0.4, reference_tolerance=0.02)
    assert metric.index(True) == 10
    assert metric_late.index(True) == 14
    assert late.scale.map is not None and at_once.scale.map is not None
    assert late.scale.map.scale == pytest.approx(3, rel=1e-4)
    assert late.scale.map.scale == at_once.scale.map.scale
    assert set(late.unused_references) == {"at a depth edge"}
    assert late.report()["scale: measured after their image"] == "16"
    assert at_once.report()["scale: measured after their image"] == "0"


def test_measurements_later_than_the_history_are_stale() -> None:
    for late, history in ((0.4, 0.0), (0.4, 0.25)):
        session, metric = late_session(late, reference_tolerance=0.02, reference_history=history)
        assert not any(metric)
        assert session.unused_references == {"stale": 16}


def test_a_measurement_of_before_a_reset_is_stale() -> None:
    session = session_of(metric_source="reference", scene_cut_threshold=0.0)
    for stamp in (1.0, 1.1):
        push(session, picture(0), stamp)
    session.add_reference(1.0, PointReference(np.ones((3, 3))))
    session.request_reset()
    push(session, picture(0), 1.3)
    assert session.unused_references == {"stale": 1}
