"""Scores during training: the same fit, clamps and metrics as everywhere."""

from __future__ import annotations

import math

import numpy as np
import pytest

from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_core.training.tasks.validation import Example, score
from tests.support.pinhole import PinholeModel, picture


def truth(image: np.ndarray, seed: int) -> np.ndarray:
    """What PinholeModel predicts, with noise of some percent."""
    noise = np.random.default_rng(seed).uniform(0.9, 1.1, image.shape[:2])
    return ((image[..., 0] / 255 + 0.5) * 3 * noise).astype(np.float32)


def test_single_frames_are_scored_under_the_image_protocol(pinhole: PinholeModel) -> None:
    images = [picture(seed=1), picture(seed=2)]
    examples = [Example(image, truth(image, seed)) for seed, image in enumerate(images)]
    examples[1].depth[5:] = np.nan
    blind = Example(images[0], np.zeros((48, 64), np.float32))
    found = score(pinhole, [*examples, blind])
    scorer = SequenceScorer()
    for example in examples:
        scorer.push(example.image[..., 0].astype(np.float32) / 255 + 0.5, example.depth)
    expected = scorer.image()
    assert expected is not None
    assert found["abs_rel"] == pytest.approx(expected.metrics["abs_rel"], rel=1e-3)
    assert found["delta1"] == pytest.approx(expected.metrics["delta1"], abs=1e-3)
    assert 0.01 < found["abs_rel"] < 0.1


def test_examples_without_known_depth_score_nothing(pinhole: PinholeModel) -> None:
    found = score(pinhole, [Example(picture(), np.full((48, 64), np.nan, np.float32))])
    assert set(found) == {"abs_rel", "delta1"} and all(map(math.isnan, found.values()))
