"""The released evaluation: matched where it is right, and its faults shown beside our numbers.

`released_*` do what the released code does; nothing of it is in the package.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dyfn_core.geometry.l1_fit import fit_scale_shift
from dyfn_core.losses.resample import nearest_valid
from dyfn_core.scoring.metrics import depth_metrics, mean_metrics
from dyfn_core.scoring.protocols import (
    ALL_PIXELS,
    LEAST_SQUARES,
    SequenceScorer,
    least_squares,
)

CLIPS = {"scannet": ("a", 10), "KITTI": ("b", 80), "sintel": ("c", 70), "bonn": ("d", 10)}
GoldenFile = Callable[[str], Path]
NAMES = {
    "abs_rel": "abs_relative_difference",
    "delta1": "delta1_acc",
    "delta2": "delta2_acc",
    "delta3": "delta3_acc",
    "rmse": "rmse_linear",
    "log10": "log10",
    "sq_rel": "squared_relative_difference",
    "rmse_log": "rmse_log",
    "i_rmse": "i_rmse",
    "silog": "silog_rmse",
}


class Clip:
    """One golden clip: predictions as the released model gives them, truth, what main() wrote."""

    def __init__(self, golden_file: GoldenFile, dataset: str) -> None:
        name, self.cap = CLIPS[dataset]
        golden = np.load(golden_file("eval_metrics.npz"))
        self.truth = np.nan_to_num(golden[f"eval/{dataset}_{name}/in/gt_depth"][:, 0], nan=0)
        stored = torch.from_numpy(golden[f"eval/{dataset}_{name}/in/pred_depth"])[:, None]
        if stored.shape[-2:] != self.truth.shape[-2:]:  # masked pixels are infinite already here
            stored = torch.nn.functional.interpolate(
                stored, self.truth.shape[-2:], mode="bilinear", align_corners=False
            )
        self.prediction = stored[:, 0].numpy()
        self.valid = (self.truth > 1e-3) & (self.truth < self.cap)
        report = json.loads(golden_file("eval_metrics.json").read_text())
        self.written: dict[str, float] = report["eval"][dataset]

    @property
    def with_zeros(self) -> np.ndarray:
        """The fault: pixels that the model masked out as depth 0."""
        return np.nan_to_num(self.prediction, nan=0, posinf=0, neginf=0)


def released_scores(clip: Clip, fits: list[tuple[float, float]]) -> dict[str, float]:
    """Frames aligned by their fits, scored over all pixels with truth, as released."""
    aligned = [s * p + t for p, (s, t) in zip(clip.with_zeros, fits, strict=True)]
    clipped = np.clip(np.stack(aligned), 1e-3, clip.cap)
    frames = [
        depth_metrics(p, d, m) for p, d, m in zip(clipped, clip.truth, clip.valid, strict=True)
    ]
    scores = mean_metrics(frames)
    # Not means over frames in the released code: log10 pools pixels, silog averages variances.
    scores["log10"] = depth_metrics(clipped, clip.truth, clip.valid)["log10"]
    scores["silog"] = float(np.sqrt(np.mean([frame["silog"] ** 2 for frame in frames])))
    return scores


def sparse(clip: Clip) -> list[tuple[np.ndarray, np.ndarray]]:
    """The released searching's samples: of a 64 x 64 grid the valid pixel nearest to each cell."""
    found = []
    for p, d, m in zip(clip.with_zeros, clip.truth, clip.valid, strict=True):
        index, there = nearest_valid(torch.from_numpy(m)[None], (64, 64))
        chosen = index[0][there[0]].numpy()
        found.append((p.ravel()[chosen], d.ravel()[chosen]))
    return found


def assert_equals(clip: Clip, scores: dict[str, float], suffix: str, rel: float) -> None:
    for ours, theirs in NAMES.items():
        expected = clip.written[f"{theirs}_{suffix}"]
        assert scores[ours] == pytest.approx(expected, rel=rel), (ours, suffix)


@pytest.mark.parametrize("dataset", CLIPS)
def test_released_least_squares_is_reproduced(golden_file: GoldenFile, dataset: str) -> None:
    """Our metrics and our least squares give all 20 released numbers of a clip."""
    clip = Clip(golden_file, dataset)
    fit = least_squares(clip.with_zeros[clip.valid], clip.truth[clip.valid])
    assert_equals(clip, released_scores(clip, [fit] * len(clip.truth)), "lstsq", 2e-5)
    fits = [
        least_squares(p[m], d[m])
        for p, d, m in zip(clip.with_zeros, clip.truth, clip.valid, strict=True)
    ]
    assert_equals(clip, released_scores(clip, fits), "per_frame_aligned_lstsq", 2e-5)


def exact_on_their_samples(clip: Clip) -> tuple[dict[str, float], dict[str, float]]:
    """Our exact fit on the released samples: per frame, and of the sequence (every T-th sample)."""
    samples = sparse(clip)
    fits = [fit_scale_shift(p, d, 1 / d) for p, d in samples]
    every = len(samples)
    p, d = (np.concatenate([pair[side] for pair in samples])[::every] for side in (0, 1))
    whole = fit_scale_shift(p, d, 1 / d)
    return released_scores(clip, fits), released_scores(clip, [whole] * every)


@pytest.mark.parametrize("dataset", ["scannet", "KITTI", "sintel"])
def test_released_weighted_l1_is_reproduced(golden_file: GoldenFile, dataset: str) -> None:
    clip = Clip(golden_file, dataset)
    image, video = exact_on_their_samples(clip)
    # Masked pixels end up at 1 mm and less: their inverse moves by more than the fits do.
    assert_equals(clip, image, "per_frame_aligned_searching", 7e-3)
    assert_equals(clip, video, "searching", 7e-3)
    for name in ("abs_rel", "delta1", "rmse", "sq_rel"):
        for scores, suffix in ((image, "per_frame_aligned_searching"), (video, "searching")):
            assert scores[name] == pytest.approx(clip.written[f"{NAMES[name]}_{suffix}"], rel=5e-4)


def test_released_l1_of_float64_truth_is_not_the_minimum_and_ours_is(
    golden_file: GoldenFile,
) -> None:
    """The same samples, the same masked zeros: AbsRel per frame 0.1412 released, 0.1195 exact."""
    clip = Clip(golden_file, "bonn")
    assert clip.truth.dtype == np.float64
    image, video = exact_on_their_samples(clip)
    released = clip.written["abs_relative_difference_per_frame_aligned_searching"]
    assert (released, image["abs_rel"]) == pytest.approx((0.1412, 0.1195), abs=6e-5)
    released = clip.written["abs_relative_difference_searching"]
    assert (released, video["abs_rel"]) == pytest.approx((0.1501, 0.1264), abs=6e-5)


def ours(clip: Clip, fit: str) -> dict[str, Any]:
    scorer = SequenceScorer(clip.cap, ALL_PIXELS, ALL_PIXELS, fit=fit)
    for prediction, truth in zip(clip.prediction, clip.truth, strict=True):
        scorer.push(prediction, np.where(truth < clip.cap, truth, 0))
    image, video = scorer.image(), scorer.video()
    assert image is not None and video is not None
    return {"image": image.metrics, "video": video.metrics, "frames": scorer.frames}


@pytest.mark.parametrize(
    ("dataset", "released", "right"),
    [
        ("scannet", 0.3088, 0.0562),
        ("KITTI", 0.1820, 0.0512),
        ("sintel", 0.1989, 0.0338),
        ("bonn", 0.1593, 0.0564),
    ],
)
def test_masked_predictions_as_depth_zero_is_the_released_fault_and_ours_leaves_them_out(
    golden_file: GoldenFile, dataset: str, released: float, right: float
) -> None:
    """AbsRel of the video protocol, least squares: the released number, and ours beside it.

    The released code keeps pixels that the model masked out, as depth 0, in fit and score.
    """
    clip = Clip(golden_file, dataset)
    assert clip.written["abs_relative_difference_lstsq"] == pytest.approx(released, abs=6e-5)
    found = ours(clip, LEAST_SQUARES)
    assert found["video"]["abs_rel"] == pytest.approx(right, abs=6e-5)
    assert all(0.85 < frame.coverage < 0.97 for frame in found["frames"])


@pytest.mark.parametrize("dataset", CLIPS)
def test_without_masked_predictions_both_agree(golden_file: GoldenFile, dataset: str) -> None:
    """Truth taken away where the model said nothing, the released way and ours are one."""
    clip = Clip(golden_file, dataset)
    clip.valid &= np.isfinite(clip.prediction)
    clip.truth = np.where(clip.valid, clip.truth, 0)
    fit = least_squares(clip.with_zeros[clip.valid], clip.truth[clip.valid])
    theirs = released_scores(clip, [fit] * len(clip.truth))
    found = ours(clip, LEAST_SQUARES)["video"]
    for name in set(NAMES) - {"log10", "silog"}:
        assert found[name] == pytest.approx(theirs[name], rel=1e-5), name
