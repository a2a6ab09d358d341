"""Evidence over time: calibrate once, hold or follow slowly, disagree with hysteresis."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyfn_core.metric.calibration import CalibrationOptions, ScaleCalibrator
from dyfn_core.metric.references import Evidence


def evidence(stamp: float, scale: float, count: int = 5, seed: int = 0) -> Evidence:
    rng = np.random.default_rng([seed, round(stamp * 1000)])
    predicted = rng.uniform(0.5, 4, count)
    measured = scale * predicted * np.exp(0.02 * rng.standard_normal(count).clip(-2, 2))
    return Evidence(stamp, predicted, measured)


def play(calibrator: ScaleCalibrator, scale: float, start: float, end: float) -> list[float]:
    """Ten measurements a second; -> the scale in force after each (NaN: none)."""
    found = []
    for step in range(round(start * 10), round(end * 10)):
        calibrator.push(evidence(step / 10, scale))
        state = calibrator.state
        found.append(math.nan if state.map is None else state.map.scale)
    return found


def test_scale_is_there_after_the_first_second_and_not_before() -> None:
    found = play(ScaleCalibrator(), 2.5, 0, 1.5)
    assert np.isnan(found[:10]).all()
    np.testing.assert_allclose(found[10:], 2.5, rtol=0.01)


def test_hold_never_moves_and_says_when_the_reference_disagrees() -> None:
    calibrator = ScaleCalibrator()
    held = play(calibrator, 2.0, 0, 2)[-1]
    assert set(play(calibrator, 3.0, 2, 4)) == {held}
    assert not calibrator.state.disagrees
    assert set(play(calibrator, 3.0, 4, 9)) == {held}
    assert calibrator.state.disagrees
    assert "1.5" in calibrator.state.problem
    play(calibrator, 2.4, 9, 14)  # nearer, but within the hysteresis
    assert calibrator.state.disagrees
    play(calibrator, 2.1, 14, 16)
    assert not calibrator.state.disagrees
    assert calibrator.state.problem == ""


def test_short_disagreement_is_forgotten() -> None:
    calibrator = ScaleCalibrator()
    play(calibrator, 2.0, 0, 2)
    for start in (2, 6, 10):
        play(calibrator, 4.0, start, start + 2)
        play(calibrator, 2.0, start + 2, start + 4)
    assert not calibrator.state.disagrees


def test_track_follows_within_its_rate_and_arrives() -> None:
    options = CalibrationOptions("track", rate=0.02)
    calibrator = ScaleCalibrator(options)
    play(calibrator, 2.0, 0, 2)
    before = calibrator.state.map
    assert before is not None
    found = [before.scale, *play(calibrator, 2.3, 2, 30)]
    steps = np.diff(np.log(found))
    assert (steps <= 0.02 * 0.1 + 1e-12).all()
    assert (np.array(found) <= 2.3 * 1.01).all()
    assert found[-1] == pytest.approx(2.3, rel=0.02)
    assert calibrator.state.recalibrations == 0


def test_track_calibrates_again_after_lasting_contradiction_only() -> None:
    calibrator = ScaleCalibrator(CalibrationOptions("track"))
    play(calibrator, 2.0, 0, 2)
    during = play(calibrator, 6.0, 2, 4.5)
    np.testing.assert_allclose(during, 2.0, rtol=0.02)
    play(calibrator, 6.0, 4.5, 8)
    assert calibrator.state.map is not None
    assert calibrator.state.map.scale == pytest.approx(6.0, rel=0.02)
    assert calibrator.state.recalibrations == 1


def test_reset_forgets_the_calibration_but_not_the_counts() -> None:
    calibrator = ScaleCalibrator()
    play(calibrator, 2.0, 0, 2)
    calibrator.push(Evidence(2.0, np.empty(0), np.empty(0), evidence(2.0, 1).dropped))
    calibrator.dropped["missing"] = 3
    calibrator.reset()
    assert calibrator.state.map is None
    assert calibrator.dropped["missing"] == 3
    np.testing.assert_allclose(play(calibrator, 5.0, 10, 12)[-1], 5.0, rtol=0.01)


def test_a_source_of_one_point_at_a_time_calibrates_once_it_has_enough() -> None:
    calibrator = ScaleCalibrator()
    for step in range(12):
        assert calibrator.state.map is None or step >= 10
        calibrator.push(evidence(step * 0.5, 2.0, count=1))
    assert calibrator.state.map is not None
    assert calibrator.state.map.scale == pytest.approx(2.0, rel=0.03)


def test_old_evidence_is_not_used_and_memory_is_bounded() -> None:
    calibrator = ScaleCalibrator()
    play(calibrator, 2.0, 0, 60)
    assert len(calibrator.state.window) <= 11
    calibrator.push(evidence(1000.0, 4.0, count=3))
    assert len(calibrator.state.window) == 1


def test_a_clock_that_was_set_back_does_not_keep_evidence_of_the_future() -> None:
    calibrator = ScaleCalibrator()
    play(calibrator, 2.0, 1000, 1002)
    play(calibrator, 2.0, 0, 3)
    assert len(calibrator.state.window) <= 11
    assert all(one.stamp < 4 for one in calibrator.state.window)


def test_empty_evidence_explains_why_there_is_no_scale() -> None:
    calibrator = ScaleCalibrator()
    calibrator.push(
        Evidence(0.0, np.empty(0), np.empty(0), dropped=type(calibrator.dropped)({"missing": 4}))
    )
    assert calibrator.state.problem == "nothing usable: missing"
    assert calibrator.dropped == {"missing": 4}


def test_shift_is_found_and_followed_when_asked_for() -> None:
    calibrator = ScaleCalibrator(CalibrationOptions("track", fit="scale_shift"))
    for step in range(20):
        predicted = np.linspace(0.5, 4, 12)
        calibrator.push(Evidence(step / 10, predicted, 2 * predicted + 0.3))
    assert calibrator.state.map is not None
    assert calibrator.state.map.scale == pytest.approx(2, rel=1e-3)
    assert calibrator.state.map.shift == pytest.approx(0.3, rel=1e-2)
    for step in range(20, 400):
        calibrator.push(Evidence(step / 10, predicted, 2 * predicted + 0.5))
    assert calibrator.state.map.shift == pytest.approx(0.5, rel=0.05)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.05, 20), st.floats(0, 0.35), st.integers(0, 10_000))
def test_tracked_scale_is_always_positive_finite_and_near_what_was_measured(
    scale: float, share: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    calibrator = ScaleCalibrator(CalibrationOptions("track"))
    for step in range(40):
        one = evidence(step / 10, scale, seed=seed)
        wrong = rng.random(5) < share
        one.measured[wrong] *= rng.uniform(0.2, 5, int(wrong.sum()))
        calibrator.push(one)
    state = calibrator.state
    if state.map is not None:
        assert abs(math.log(state.map.scale / scale)) < 0.15


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"mode": "follow"}, "mode 'follow' is unknown"),
        ({"fit": "affine"}, "fit 'affine' is unknown"),
        ({"seconds": 0.0}, "seconds must be positive"),
        ({"rate": math.nan}, "rate must be positive"),
        ({"min_points": 1}, "min_points must be at least 2"),
    ],
)
def test_bad_options_are_refused(options: dict[str, object], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        CalibrationOptions(**options)  # type: ignore[arg-type]


def test_late_evidence_counts_as_if_it_had_come_in_time() -> None:
    in_time, late = ScaleCalibrator(), ScaleCalibrator()
    stamps = [step / 10 for step in range(30)]
    swapped = [stamp for pair in zip(stamps[1::2], stamps[::2], strict=True) for stamp in pair]
    for one, other in zip(stamps, swapped, strict=True):
        in_time.push(evidence(one, 2.0))
        late.push(evidence(other, 2.0))
    window = [one.stamp for one in late.state.window]
    assert window == [one.stamp for one in in_time.state.window]
    assert late.state.stamp == in_time.state.stamp == stamps[-1]
    assert late.state.map is not None
    assert late.state.map.scale == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("scale", [1e38, 1e4, 1e-4])
@pytest.mark.parametrize("mode", ["hold", "track"])
def test_a_scale_of_no_camera_s_world_is_refused_and_the_next_good_one_taken(
    scale: float, mode: str
) -> None:
    """Two units of depth in the middle of a picture are neither 20 km nor 0.2 mm."""
    calibrator = ScaleCalibrator(CalibrationOptions(mode=mode))
    for step in range(30):
        calibrator.push(replace(evidence(step / 10, scale), middle=2.0))
    assert calibrator.state.map is None
    assert "implausible scale" in calibrator.state.problem
    assert "expected 0.005 to 2000" in calibrator.state.problem
    for step in range(30, 50):
        calibrator.push(replace(evidence(step / 10, 2.5), middle=2.0))
    assert calibrator.state.map is not None
    assert calibrator.state.map.scale == pytest.approx(2.5, rel=0.02)
    for step in range(50, 120):
        calibrator.push(replace(evidence(step / 10, scale), middle=2.0))
    assert calibrator.state.map.scale == pytest.approx(2.5, rel=0.02)
    assert calibrator.state.problem
