"""The video protocol as a loss: the evaluation's number, and its gradient."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dyfn_core.geometry.l1_fit import fit_scale_shift
from dyfn_core.losses.video_protocol import video_protocol_loss
from dyfn_core.scoring.protocols import SequenceScorer
from tests.support.seeded import normal, uniform


def clips(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    truth = uniform(rng, 2, 5, 48, dtype=torch.float64) * 4 + 1
    noise = normal(rng, 2, 5, 48, dtype=torch.float64)
    drift = normal(rng, 2, 5, 1, dtype=torch.float64)
    return truth * (0.1 * noise + 0.3 * drift).exp() * 0.5 + 0.2, truth


def test_loss_is_the_video_protocols_abs_rel() -> None:
    prediction, truth = clips(0)
    scores = []
    for p, d in zip(prediction, truth, strict=True):
        scorer = SequenceScorer()
        for frame, true in zip(p.numpy(), d.numpy(), strict=True):
            scorer.push(frame.reshape(6, 8), true.reshape(6, 8))
        video = scorer.video()
        assert video is not None
        scores.append(video.metrics["abs_rel"])
    found = float(video_protocol_loss(prediction, truth))
    assert found == pytest.approx(np.mean(scores), rel=1e-4)  # the scorer keeps float32


def test_gradient_is_that_of_the_minimum() -> None:
    """Where the minimum is smooth, the difference of two minima is the gradient to the last bits.

    The best fit passes through two samples of a clip, and the error has a kink at each. As long
    as these two samples stay and no other sample meets the fit, the fit stays too, and the error
    is linear in the other samples.
    """
    prediction, truth = clips(1)
    prediction.requires_grad_()
    (gradient,) = torch.autograd.grad(video_protocol_loss(prediction, truth), prediction)
    prediction = prediction.detach()
    fits = [
        fit_scale_shift(p.numpy().ravel(), d.numpy().ravel(), 1 / d.numpy().ravel())
        for p, d in zip(prediction, truth, strict=True)
    ]
    scale, shift = torch.tensor(fits, dtype=torch.float64).T[:, :, None, None]
    residual = (scale * prediction + shift - truth).abs()
    kink = residual < 1e-12
    assert kink.flatten(1).sum(1).tolist() == [2, 2]
    assert residual[~kink].min() > 1e-3  # metres to the next kink
    direction = normal(2, 2, 5, 1, dtype=torch.float64)  # every frame by its own factor
    step = torch.where(kink, 0.0, 1e-5 * direction * prediction)
    assert (scale * step).abs().max() < 1e-3
    ahead = video_protocol_loss(prediction + step, truth)
    behind = video_protocol_loss(prediction - step, truth)
    assert float((gradient * step).sum()) == pytest.approx(float(ahead - behind) / 2, rel=1e-6)
    steepest = scale / truth / truth.numel()  # of one sample, on either side of its kink
    torch.testing.assert_close(gradient.abs()[~kink], steepest.expand_as(truth)[~kink])
    assert (gradient.abs() <= steepest * (1 + 1e-9))[kink].all()


def test_one_scale_and_shift_cost_nothing_and_drift_does() -> None:
    _, truth = clips(3)
    assert float(video_protocol_loss(3 * truth + 1, truth)) < 1e-9
    drift = torch.linspace(0.7, 1.4, 5, dtype=torch.float64)[:, None]
    assert float(video_protocol_loss(drift * truth, truth)) > 0.05


def test_unknown_depth_and_empty_clips_count_for_nothing() -> None:
    prediction, truth = clips(4)
    alone = video_protocol_loss(prediction[:1], truth[:1])
    truth[1] = torch.nan
    assert torch.equal(video_protocol_loss(prediction, truth), alone)
    prediction.requires_grad_()
    nothing = video_protocol_loss(prediction, torch.full_like(truth, torch.nan))
    (gradient,) = torch.autograd.grad(nothing, prediction)
    assert float(nothing) == 0 and not gradient.any()


def test_a_weight_counts_as_so_many_samples_and_zero_as_none() -> None:
    prediction, truth = clips(3)
    weights = torch.ones_like(truth)
    weights[:, :, ::2] = 2.0
    twice = [torch.cat([part, part[:, :, ::2]], 2) for part in (prediction, truth)]
    found = float(video_protocol_loss(prediction, truth, weights))
    assert found == pytest.approx(float(video_protocol_loss(*twice)), rel=1e-9)
    weights[:, :, ::2] = 0.0
    half = [part[:, :, 1::2] for part in (prediction, truth)]
    found = float(video_protocol_loss(prediction, truth, weights))
    assert found == pytest.approx(float(video_protocol_loss(*half)), rel=1e-9)
