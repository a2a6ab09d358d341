"""How far the frames' own scales lie apart within a clip: what the video protocol punishes."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.losses.target import ClipTarget


def scale_spread_loss(points: Tensor, target: ClipTarget) -> Tensor:
    """mean_j |e_j - mean_j e_j|, e_j = mean_i (log z_ji - log z*_ji); not of the paper.

    Unlike the alignment terms it cannot be lowered by flattening the depth.

    Args:
        points: Predicted points, B x T x H x W x 3 with z > 0.
        target: The true geometry of the clips.

    Returns:
        The mean over clips; frames without a valid pixel do not count, a clip with fewer than two
        frames is 0.
    """
    truth = torch.where(target.valid, target.points[..., 2], 1.0)
    ratio = torch.where(target.valid, points[..., 2].log() - truth.log(), 0.0)
    count = target.valid.sum((2, 3))
    seen = (count > 0).float()
    scale = ratio.sum((2, 3)) / count.clamp(min=1)
    return spread(scale, seen)


def spread(values: Tensor, seen: Tensor) -> Tensor:
    """Mean absolute deviation from the mean of each row.

    Args:
        values: B x T, finite.
        seen: B x T, 1 where a value counts, else 0.

    Returns:
        The mean over the rows.
    """
    frames = seen.sum(1, keepdim=True).clamp(min=1)
    mean = (values * seen).sum(1, keepdim=True) / frames
    return (((values - mean).abs() * seen).sum(1) / frames[:, 0]).mean()
