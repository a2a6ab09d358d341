"""Depth metrics, by hand and against the released implementation."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dyfn_core.scoring.metrics import METRICS, depth_metrics, mean_metrics

GOLDEN_NAMES = {
    "abs_relative_difference": "abs_rel",
    "delta1_acc": "delta1",
    "delta2_acc": "delta2",
    "delta3_acc": "delta3",
    "rmse_linear": "rmse",
    "log10": "log10",
    "squared_relative_difference": "sq_rel",
    "rmse_log": "rmse_log",
    "i_rmse": "i_rmse",
    "silog_rmse": "silog",
}


def test_a_perfect_prediction_has_no_error() -> None:
    depth = np.array([[1.0, 2.0], [3.0, 4.0]])
    scores = depth_metrics(depth, depth)
    assert set(scores) == set(METRICS)
    assert scores.pop("delta1") == scores.pop("delta2") == scores.pop("delta3") == 1
    assert all(value == 0 for value in scores.values())


def test_values_by_hand() -> None:
    scores = depth_metrics(np.array([1.2, 3.0]), np.array([1.0, 4.0]))
    assert scores["abs_rel"] == pytest.approx((0.2 + 0.25) / 2)
    assert scores["delta1"] == 0.5  # 1.2 is inside, 4 / 3 is not
    assert scores["delta2"] == 1
    assert scores["rmse"] == pytest.approx(np.sqrt((0.04 + 1) / 2))
    assert scores["log10"] == pytest.approx((np.log10(1.2) + np.log10(4 / 3)) / 2)
    assert scores["silog"] == pytest.approx(100 * np.std([np.log(1.2), np.log(0.75)]))


def test_masked_pixels_do_not_count() -> None:
    prediction, target = np.array([1.0, np.nan, 9.0]), np.array([1.0, 2.0, 0.0])
    assert depth_metrics(prediction, target, np.array([True, False, False]))["abs_rel"] == 0


@pytest.mark.parametrize(
    ("prediction", "target", "mask", "message"),
    [
        (np.ones(2), np.ones(3), None, "share one shape"),
        (np.ones(2), np.ones(2), np.ones(3, bool), "share one shape"),
        (np.ones(2), np.ones(2), np.zeros(2, bool), "no valid pixel"),
        (np.zeros(2), np.ones(2), None, "prediction must be finite and positive"),
        (np.ones(2), np.array([1, np.inf]), None, "target must be finite and positive"),
    ],
)
def test_bad_input_is_named(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray | None, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        depth_metrics(prediction, target, mask)


def test_mean_over_no_frames_is_an_error() -> None:
    with pytest.raises(ValueError, match="no frame"):
        mean_metrics([])


@pytest.mark.parametrize("case", ["rep0", "rep1"])
def test_matches_the_released_metrics(golden_file: Callable[[str], Path], case: str) -> None:
    golden = np.load(golden_file("eval_metrics.npz"))
    output, target, mask = (golden[f"metric/{case}/in/{n}"] for n in ("output", "target", "mask"))
    size = output.shape[-2:]
    frames = [a.reshape(-1, *size) for a in (output, target, mask)]
    scores = [depth_metrics(p, d, m) for p, d, m in zip(*frames, strict=True)]
    ours = mean_metrics(scores)
    # The released log10 pools the pixels of all frames and silog averages the variances; the
    # others are means over frames, as all of ours are.
    ours["log10"] = depth_metrics(output, target, mask)["log10"]
    ours["silog"] = float(np.sqrt(np.mean([score["silog"] ** 2 for score in scores])))
    for theirs, name in GOLDEN_NAMES.items():
        expected = float(golden[f"metric/{case}/out/{theirs}"])
        assert ours[name] == pytest.approx(expected, rel=2e-5), name
