"""The video protocol's own error as a loss (paper section 5)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.l1_fit import fit_scale_shift

FEWEST = 16  # valid samples of a clip, as of a frame in evaluation


def video_protocol_loss(prediction: Tensor, truth: Tensor, weights: Tensor | None = None) -> Tensor:
    """min_(s, t) mean_ji w_ji |s p_ji + t - d_ji| / d_ji (paper section 5; there w is 1).

    s and t are the exact minimum of this same error, so no gradient has to flow through them: at a
    minimum it is that of the error with s and t held.

    Args:
        prediction: Positive depths, B x T x N.
        truth: True depths, B x T x N metres, not finite where unknown.
        weights: B x T x N, not negative; None: all alike.

    Returns:
        The mean over clips with FEWEST known samples; 0 without any.
    """
    losses = []
    weights = torch.ones_like(truth) if weights is None else weights
    clips = zip(prediction.flatten(1), truth.flatten(1), weights.flatten(1), strict=True)
    for p, d, w in clips:
        known = torch.isfinite(d) & (w > 0)
        if known.sum() < FEWEST:
            continue
        p, d, w = p[known], d[known], w[known] / w[known].mean()
        scale, shift = fit_scale_shift(
            p.detach().cpu().numpy(), d.cpu().numpy(), (w / d).cpu().numpy()
        )
        losses.append((w * (scale * p + shift - d).abs() / d).mean())
    return torch.stack(losses).mean() if losses else 0.0 * prediction.sum()
