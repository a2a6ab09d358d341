"""Variants of one sequence side by side, their four numbers, and means over sequences."""

import math

import numpy as np
import pytest

from dyfn_core.prediction import DISPARITY
from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_core.scoring.variants import VariantScore, VariantScorers, mean_scores

SCALES = (0.5, 1.0, 2.0)


def scene(seed: int) -> np.ndarray:
    """Depth of 1 to 5 m."""
    return np.random.default_rng(seed).uniform(1, 5, (24, 32)).astype(np.float32)


def test_numbers_are_those_of_the_scorer_and_maps_have_the_size_of_the_truth() -> None:
    scorers = VariantScorers(("steady", "drifting"), controls={"ramp": "the ramp"})
    alone = SequenceScorer()
    for index, scale in enumerate(SCALES):
        truth = scene(index)
        large = np.repeat(np.repeat(truth, 2, 0), 2, 1)
        maps = scorers.push({"steady": large, "drifting": large * scale}, truth)
        assert {values.shape for values in maps.values()} == {truth.shape}
        alone.push(maps["drifting"], truth)
    scores = scorers.scores()
    assert list(scores) == ["steady", "drifting", "the ramp"]
    image, video = alone.image(), alone.video()
    assert image is not None and video is not None
    assert scores["drifting"] == VariantScore(
        image.metrics["abs_rel"],
        image.metrics["delta1"],
        video.metrics["abs_rel"],
        video.metrics["delta1"],
    )
    steady = scores["steady"]
    assert steady is not None and steady.video_abs_rel < 1e-5 < 0.1 < video.metrics["abs_rel"]


def test_controls_are_scored_where_the_first_variant_predicts() -> None:
    scorers = VariantScorers(("one", "other"), controls={"constant": "constant"})
    half = scene(0)
    half[:12] = np.nan
    maps = scorers.push({"one": half, "other": scene(0)}, scene(0))
    assert [scorers.scorers[name].frames[0].pixels for name in scorers.scorers] == [384, 768, 384]
    assert np.isnan(maps["constant"][:12]).all() and not np.isnan(maps["constant"][12:]).any()


def test_controls_may_do_with_fewer_samples_and_lose_to_a_good_prediction() -> None:
    scorers = VariantScorers(
        ("good",),
        controls={"constant": "constant"},
        control_scorer=lambda quantity: SequenceScorer(samples_per_frame=192, quantity=quantity),
    )
    for index in range(3):
        scorers.push({"good": scene(index) * 3}, scene(index))
    assert [len(s.frames) for s in scorers.scorers.values()] == [3, 3]
    assert [s.frames[0].pixels for s in scorers.scorers.values()] == [768, 192]
    scores = scorers.scores()
    good, flat = scores["good"], scores["constant"]
    assert good is not None and flat is not None
    assert good.image_abs_rel < 0.001 < 0.2 < flat.image_abs_rel


def test_disparity_is_aligned_with_the_inverse_of_depth_and_controls_as_depth() -> None:
    scorers = VariantScorers(("disparity",), DISPARITY, controls={"constant": "constant"})
    truth = scene(3)
    scorers.push({"disparity": 7 / truth + 1}, truth)
    found = scorers.scores()["disparity"]
    assert found is not None and found.image_abs_rel < 1e-5
    assert scorers.first.quantity == DISPARITY
    assert scorers.scorers["constant"].quantity != DISPARITY


def test_means_leave_out_what_could_not_be_scored() -> None:
    blind = VariantScorers(("x",))
    blind.push({"x": scene(0)}, np.full((24, 32), np.nan, np.float32))
    unknown = blind.scores()["x"]
    assert unknown is None
    found = mean_scores([VariantScore(0.1, 0.9, 0.3, 0.5), unknown, VariantScore(0.3, 0.7, 0.5, 1)])
    assert found.image_abs_rel == pytest.approx(0.2)
    assert found.video_delta1 == pytest.approx(0.75)
    assert math.isnan(mean_scores([unknown]).video_abs_rel)
