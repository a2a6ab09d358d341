"""The image, video and metric protocols: what alignment forgives, and what it does not."""

import math

import numpy as np
import pytest

from dyfn_core.scoring.protocols import (
    SequenceScorer,
    constant,
    drift,
    ramp,
    sample_grid,
    spread,
)


def scene(seed: int, shape: tuple[int, int] = (24, 32)) -> np.ndarray:
    """A depth image of 1 to 5 m that no ramp explains."""
    rng = np.random.default_rng(seed)
    return rng.uniform(1, 5, shape)


def test_image_protocol_forgives_a_scale_per_frame_and_video_does_not() -> None:
    scorer = SequenceScorer()
    for index, scale in enumerate([0.5, 1.0, 2.0]):
        truth = scene(index)
        score = scorer.push((truth - 0.3) * scale, truth)
        assert score.scale == pytest.approx(1 / scale, rel=1e-5)
        assert score.shift == pytest.approx(0.3, abs=1e-5)
    image, video = scorer.image(), scorer.video()
    assert image is not None and video is not None
    assert image.metrics["abs_rel"] < 1e-5
    assert image.metrics["delta1"] == 1
    assert video.metrics["abs_rel"] > 0.2
    assert video.metrics["delta1"] < 0.7


def test_video_protocol_forgives_one_scale_and_shift() -> None:
    scorer = SequenceScorer()
    for index in range(3):
        scorer.push(scene(index) / 4 - 0.1, scene(index))
    video, metric = scorer.video(), scorer.metric()
    assert video is not None and metric is not None
    assert (video.scale, video.shift) == pytest.approx((4, 0.4), abs=1e-4)
    assert video.metrics["abs_rel"] < 1e-5
    assert metric.metrics["abs_rel"] > 0.5
    assert (metric.scale, metric.shift) == (1, 0)


def test_metrics_are_means_over_frames_not_over_pixels() -> None:
    scorer = SequenceScorer()
    truth = np.full((8, 8), 2.0)
    scorer.push(np.full((8, 8), 2.2), truth)
    sparse = truth.copy()
    sparse[4:] = np.nan
    scorer.push(np.full((8, 8), 2.4), sparse)
    metric = scorer.metric()
    assert metric is not None
    assert metric.metrics["abs_rel"] == pytest.approx((0.1 + 0.2) / 2)


def test_invalid_predictions_lower_coverage_and_nothing_else() -> None:
    truth = scene(0)
    prediction = truth / 2
    prediction[:6] = np.nan
    prediction[6:8] = np.inf
    prediction[8:10] = 0
    mask = np.ones(truth.shape, bool)
    mask[10:12] = False
    score = SequenceScorer().push(prediction, truth, mask)
    assert score.coverage == 0.5
    assert score.pixels == truth.size // 2
    assert score.metrics is not None and score.metrics["abs_rel"] < 1e-6


def test_truth_beyond_the_cap_is_not_scored_and_the_prediction_is_clipped_to_it() -> None:
    truth = np.full((8, 8), 5.0)
    truth[0] = 50
    truth[1] = [0, -1, np.nan, np.inf, 5, 5, 5, 5]
    scorer = SequenceScorer(depth_max=10)
    score = scorer.push(np.full((8, 8), 100.0), truth)
    assert score.pixels == 52
    metric = scorer.metric()
    assert metric is not None
    assert metric.metrics["abs_rel"] == 1  # (10 - 5) / 5


def test_a_frame_without_truth_is_listed_but_not_averaged() -> None:
    scorer = SequenceScorer()
    assert scorer.image() is None and scorer.video() is None and scorer.metric() is None
    empty = scorer.push(scene(0), np.full((24, 32), np.nan))
    assert (empty.metrics, empty.coverage, empty.pixels) == (None, 0.0, 0)
    scorer.push(scene(1), scene(1))
    image, video = scorer.image(), scorer.video()
    assert image is not None and video is not None
    assert image.frames[0] is None and video.frames[0] is None
    assert image.metrics["delta1"] == 1


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match=r"\(4, 4\).*\(4, 5\)"):
        SequenceScorer().push(np.ones((4, 4)), np.ones((4, 5)))


def test_memory_is_bounded_and_the_result_hardly_changes() -> None:
    bounded, full = SequenceScorer(max_samples=2000), SequenceScorer()
    for index in range(12):
        truth = scene(index)
        prediction = truth**0.9 * (1 + 0.02 * index)
        bounded.push(prediction, truth)
        full.push(prediction, truth)
    assert bounded._kept.size <= 2000
    assert len(bounded._kept) == 12
    a, b = bounded.video(), full.video()
    assert a is not None and b is not None
    assert a.metrics["abs_rel"] == pytest.approx(b.metrics["abs_rel"], rel=0.1)
    assert a.metrics != b.metrics


@pytest.mark.parametrize("shape", [(48, 64), (240, 320), (7, 500), (1080, 1920)])
def test_the_sample_grid_is_dense_and_bounded(shape: tuple[int, int]) -> None:
    chosen = np.zeros(shape)[sample_grid(shape, 1000)]
    assert 250 < chosen.size <= 1100


def test_the_ramp_explains_a_floor_and_the_constant_a_wall() -> None:
    rows = np.arange(24)[:, None]
    floor = np.repeat(6 - rows / 8, 32, axis=1)
    scorer = SequenceScorer()
    assert scorer.push(ramp((24, 32)), floor).metrics["abs_rel"] < 1e-6  # type: ignore[index]
    assert scorer.push(constant((24, 32)), floor * 0 + 3).metrics["abs_rel"] < 1e-6  # type: ignore[index]


@pytest.mark.parametrize("quantity", ["depth", "disparity"])
def test_drift_is_that_of_true_over_aligned_depth(quantity: str) -> None:
    """One alignment fits the frames that agree; a frame's own shift is no drift of its own."""
    scorer = SequenceScorer(quantity=quantity)
    for index, factor in enumerate([1, 1, 1, 1, 1.25, 0.8]):
        depth = scene(index) * np.float32(factor)
        scorer.push(depth if quantity == "depth" else 1 / depth, scene(index))
    video = scorer.video()
    assert video is not None
    assert [*video.ratios] == pytest.approx([1, 1, 1, 1, 0.8, 1.25], rel=0.02)
    found = drift(video)
    assert found is not None
    step = math.log(1.25)
    assert found["log_std"] == pytest.approx(np.std([0] * 4 + [-step, step]), rel=0.05)
    assert found["max_step"] == pytest.approx(2 * step, rel=0.05)
    scorer.push(np.full_like(scene(0), np.nan), scene(0))
    unscored = scorer.video()
    assert unscored is not None and math.isnan(unscored.ratios[-1]) and drift(unscored) == found


def test_drift_needs_two_scored_frames() -> None:
    scorer = SequenceScorer()
    assert drift(scorer.video()) is None
    scorer.push(scene(0), scene(0))
    assert drift(scorer.video()) is None


def test_spread_measures_the_wandering_scale() -> None:
    scorer = SequenceScorer()
    assert spread(scorer.frames) is None
    for index, scale in enumerate([1.0, np.e, 1.0]):
        scorer.push(scene(index) / scale, scene(index))
    measured = spread(scorer.frames)
    assert measured is not None
    assert measured["log_scale_std"] == pytest.approx(np.std([0, 1, 0]), abs=1e-4)
    assert measured["log_scale_max_step"] == pytest.approx(1, abs=1e-4)
    assert measured["not_positive"] == 0
    scorer.push(10 - scene(3), scene(3))
    assert spread(scorer.frames)["not_positive"] == 1  # type: ignore[index]
