"""The video protocol as a loss: the evaluation's number, and its gradient."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dyfn_core.losses.video_protocol import video_protocol_loss
from dyfn_core.scoring.protocols import SequenceScorer


def clips(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    truth = torch.rand(2, 5, 48, generator=generator, dtype=torch.float64) * 4 + 1
    noise = torch.randn(2, 5, 48, generator=generator, dtype=torch.float64)
    drift = torch.randn(2, 5, 1, generator=generator, dtype=torch.float64)
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
    prediction, truth = clips(1)
    prediction.requires_grad_()
    (gradient,) = torch.autograd.grad(video_protocol_loss(prediction, truth), prediction)
    direction = torch.randn(2, 5, 1, generator=torch.Generator().manual_seed(2)).double()
    step = 1e-5 * direction * prediction.detach()  # every frame by its own factor
    with torch.no_grad():
        ahead = video_protocol_loss(prediction + step, truth)
        behind = video_protocol_loss(prediction - step, truth)
    # The fit passes through two of a clip's 240 samples, where the error has a kink.
    assert float((gradient * step).sum()) == pytest.approx(float(ahead - behind) / 2, rel=0.05)


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
