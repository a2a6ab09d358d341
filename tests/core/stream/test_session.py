"""A session: when it resets and why, its stages, its options; no ROS anywhere."""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.metric.calibration import FITS, MODES, CalibrationOptions
from dyfn_core.metric.scale import SOURCES, ScaleOptions
from dyfn_core.prediction import DISPARITY, Frame, Prediction
from dyfn_core.stream.metric_stage import scale_options
from dyfn_core.stream.model_stage import ModelStage
from dyfn_core.stream.motion_stage import MotionStage
from dyfn_core.stream.options import StreamOptions, add_options, options_from, options_of
from dyfn_core.stream.resets import (
    BACKWARDS,
    FAILED,
    GAP,
    NEW_CAMERA,
    NEW_FRAME_ID,
    NEW_SETTINGS,
    NEW_SIZE,
)
from dyfn_core.stream.session import ResetRequest, StreamSession
from dyfn_core.stream.stages import StreamStage
from tests.support.tiny_model import FAILING, load_tiny

IMAGE = np.full((24, 32, 3), 90, np.uint8)
ANY_PICTURE = {"scene_cut_threshold": 0.0, "blank_contrast": 0.0}
MATRIX = np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]])


def session_of(**options: Any) -> StreamSession:
    return StreamSession(load_tiny(), StreamOptions(**{**ANY_PICTURE, **options}))


def seen(
    session: StreamSession, frames: list[dict[str, Any]], asked: list[ResetRequest] | None = None
) -> list[tuple[int, str | None]]:
    """Per frame: how many the stream has seen since its reset, and the reason of a reset."""
    found = []
    for index, frame in enumerate(frames):
        request = None if asked is None else asked[index]
        one = session.push(Frame(**{"image": IMAGE, **frame}), asked=request)
        assert session.stream is not None
        found.append((session.stream.memory.frames, one.reset))
    return found


def test_each_request_resets_once_with_its_reason() -> None:
    session = session_of()
    asked = [ResetRequest(count, f"number {count}") for count in (0, 0, 0, 1, 1, 3)]
    assert seen(session, [{}] * 6, asked) == [
        *((1, None), (2, None), (3, None)),
        *((1, "number 1"), (2, None), (1, "number 3")),
    ]
    assert session.resets == {"number 1": 1, "number 3": 1}


def test_frames_from_before_a_request_still_see_the_old_memory() -> None:
    session = session_of()
    before = session.asked
    assert seen(session, [{}]) == [(1, None)]
    session.request_reset("now")
    assert seen(session, [{}], [before]) == [(2, None)]
    assert seen(session, [{}, {}]) == [(1, "now"), (2, None)]


def test_a_request_before_the_first_frame_resets_nothing() -> None:
    session = session_of()
    session.request_reset()
    assert seen(session, [{"stamp": 100.0}, {"stamp": 100.1}]) == [(1, None), (2, None)]
    assert not session.resets


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"image": np.zeros((32, 24, 3), np.uint8)}, NEW_SIZE),
        ({"frame_id": "left"}, NEW_FRAME_ID),
        ({"camera_matrix": MATRIX}, NEW_CAMERA),
    ],
)
def test_another_camera_resets_the_stream(change: dict[str, Any], reason: str) -> None:
    session = session_of()
    expected = [(1, None), (2, None), (1, reason), (2, None), (1, reason)]
    assert seen(session, [{}, {}, change, change, {}]) == expected
    assert session.resets == {reason: 2}


@pytest.mark.parametrize("change", [{"stabilize": False}, {"num_tokens": 100}])
def test_other_settings_reset_the_stream(change: dict[str, Any]) -> None:
    session = session_of()
    assert seen(session, [{}, {}]) == [(1, None), (2, None)]
    session.options = replace(session.options, **change)
    assert seen(session, [{}, {}]) == [(1, NEW_SETTINGS), (2, None)]


def test_the_same_camera_matrix_for_another_size_is_kept() -> None:
    session = session_of()
    small = Frame(IMAGE[:20], camera_matrix=MATRIX)
    session.push(Frame(IMAGE, camera_matrix=MATRIX))
    found = session.push(small)
    assert found.reset == NEW_SIZE
    alone = session_of().push(small)
    np.testing.assert_array_equal(found.points, alone.points)
    assert found.camera_matrix is MATRIX


def test_stamps_that_go_back_or_leave_a_gap_reset_and_small_steps_do_not() -> None:
    session = session_of(stamp_tolerance=0.2, max_gap=5.0)
    stamps = [10.0, 10.1, 9.95, 14.95, 14.7, 3.0, 8.0, 13.1, None, 1.0]
    assert [reason for _, reason in seen(session, [{"stamp": s} for s in stamps])] == [
        *(None, None, None, None, BACKWARDS, BACKWARDS, None, GAP, None, None),
    ]


def test_no_gap_is_too_long_when_the_limit_is_zero() -> None:
    session = session_of(max_gap=0.0)
    assert seen(session, [{"stamp": 1.0}, {"stamp": 1e6}]) == [(1, None), (2, None)]


def test_after_an_exception_the_stream_resets() -> None:
    session = session_of()
    session.push(Frame(IMAGE))
    with pytest.raises(RuntimeError, match="must fail"):
        session.push(Frame(np.full_like(IMAGE, FAILING)))
    assert seen(session, [{}, {}]) == [(1, FAILED), (2, None)]
    assert session.resets == {FAILED: 1}


@pytest.mark.parametrize("stamps", [(1.0, float("nan")), (1.0, float("inf"))])
def test_a_stamp_that_is_no_time_is_refused(stamps: tuple[float, float]) -> None:
    session = session_of()
    session.push(Frame(IMAGE, stamps[0]))
    with pytest.raises(ValueError, match="finite number of seconds"):
        session.push(Frame(IMAGE, stamps[1]))


def test_the_camera_is_the_given_one_or_the_estimate_in_pixels() -> None:
    session = session_of()
    assert session.push(Frame(IMAGE, camera_matrix=MATRIX)).camera_matrix is MATRIX
    found = session.push(Frame(IMAGE))
    assert found.known_camera is None
    np.testing.assert_array_equal(
        found.camera_matrix, pixel_intrinsics(found.intrinsics, IMAGE.shape[:2])
    )


def test_what_is_not_visible_is_not_valid() -> None:
    visible = np.arange(24 * 32).reshape(24, 32) % 2 == 0
    found = session_of().push(Frame(IMAGE, visible=visible))
    whole = session_of().push(Frame(IMAGE))
    assert whole.valid.any()
    np.testing.assert_array_equal(found.valid, whole.valid & visible)


class CutStage(StreamStage):
    """Asks for a reset at stamps 0 and 2 and doubles the geometry."""

    def __init__(self) -> None:
        self.starts: list[str | None] = []

    def before_frame(self, frame: Frame) -> str | None:
        return "a cut" if frame.stamp in (0.0, 2.0) else None

    def started(self, reason: str | None) -> None:
        self.starts.append(reason)

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        return prediction.scaled(2.0)

    def report(self) -> dict[str, str]:
        return {"starts": str(len(self.starts))}

    def problems(self) -> list[str]:
        return ["a problem"]


def test_a_stage_of_ones_own_resets_scales_and_reports() -> None:
    stage = CutStage()
    options = StreamOptions(scene_cut_threshold=0.0, metric_source="fixed", metric_scale=3.0)
    session = StreamSession(load_tiny(), options, stages=[stage])
    frames = [{"stamp": float(i)} for i in range(4)]
    assert seen(session, frames) == [(1, None), (2, None), (1, "a cut"), (2, None)]
    assert stage.starts == [None, "a cut"]
    plain = session_of().push(Frame(IMAGE))
    alone = StreamSession(load_tiny(), options, stages=[CutStage()]).push(Frame(IMAGE))
    assert alone.metric
    np.testing.assert_allclose(alone.depth[plain.valid], 6 * plain.depth[plain.valid], rtol=1e-6)
    assert session.report()["starts"] == "2"
    assert session.problems() == ["a problem"]


def test_only_live_options_change_while_a_session_runs() -> None:
    session = session_of(metric_source="fixed")
    session.options = replace(session.options, metric_scale=2.0, max_gap=0.0)
    with pytest.raises(ValueError, match="metric_source is 'fixed' for the whole session"):
        session.options = replace(session.options, metric_source="none")
    assert session.options.metric_scale == 2.0


def test_a_model_of_disparity_gives_no_metres() -> None:
    model = load_tiny()
    model.quantity = DISPARITY
    with pytest.raises(ValueError, match="metric_source is 'fixed', but the model predicts"):
        StreamSession(model, StreamOptions(metric_source="fixed"))


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("max_gap", -1.0, "max_gap is -1.0, expected 0 to 1000000"),
        ("calibration_points", 1, "expected 2 to 100000"),
        ("metric_scale", float("nan"), "metric_scale is nan"),
        ("metric_source", "gps", "metric_source is 'gps', expected one of"),
    ],
)
def test_a_bad_option_is_refused_by_the_library_and_on_the_command_line(
    name: str, value: Any, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ValueError, match=expected):
        StreamOptions(**{name: value})
    parser = argparse.ArgumentParser()
    add_options(parser)
    flag = f"--{name.replace('_', '-')}"
    with pytest.raises(SystemExit):
        parser.parse_args([f"{flag}={value}"])
    told = capsys.readouterr().err
    assert f"argument {flag}: " in told
    assert "expected " in told or "choose from" in told


def test_the_command_line_has_every_option_with_its_default() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--other", default=1)
    add_options(parser)
    assert options_from(parser.parse_args([])) == StreamOptions()
    given = ["--no-stabilize", "--metric-source", "fixed", "--metric-scale", "2.5"]
    found = options_from(parser.parse_args([*given, "--calibration-points", "3"]))
    assert found == StreamOptions(
        stabilize=False, metric_source="fixed", metric_scale=2.5, calibration_points=3
    )
    shown = " ".join(parser.format_help().split())
    for name, described in options_of(StreamOptions).items():
        assert described.description in shown, name
    assert set(options_of(StreamOptions)) == {field.name for field in fields(StreamOptions)}


def test_the_scale_is_found_with_the_library_s_defaults() -> None:
    assert scale_options(StreamOptions()) == ScaleOptions()
    assert ScaleOptions().calibration == CalibrationOptions()
    described = options_of(StreamOptions)
    assert described["metric_source"].choices == (
        *SOURCES,
        MotionStage.source,
        ModelStage.source,
    )
    assert described["calibration"].choices == MODES
    assert described["calibration_fit"].choices == FITS


def test_normalised_and_pixel_intrinsics_project_to_the_same_place() -> None:
    intrinsics = np.array([[0.9, 0, 0.45], [0, 1.3, 0.52], [0, 0, 1]])
    matrix = pixel_intrinsics(intrinsics, (48, 64))
    ray = np.array([0.2, -0.1, 1.0])
    x, y, _ = intrinsics @ ray
    u, v, _ = matrix @ ray
    assert ((u + 0.5) / 64, (v + 0.5) / 48) == pytest.approx((x, y))
