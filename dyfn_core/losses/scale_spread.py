"""How far the frames' own scales lie apart within a clip: what the video protocol punishes."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.losses.clip_alignment import ClipTarget


def scale_spread_loss(points: Tensor, target: ClipTarget) -> Tensor:
    """Mean absolute deviation of the frames' log scales from their clip's mean.

    points: B x T x H x W x 3 with z > 0. A frame's log scale is the mean of log z_i - log z*_i over
    its valid pixels. Unlike the alignment terms it cannot be lowered by flattening the depth.
    Frames without a valid pixel count for nothing; a clip with fewer than two frames is 0.
    """
    truth = torch.where(target.valid, target.points[..., 2], 1.0)
    ratio = torch.where(target.valid, points[..., 2].log() - truth.log(), 0.0)
    count = target.valid.sum((2, 3))
    seen = (count > 0).float()
    scale = ratio.sum((2, 3)) / count.clamp(min=1)
    return spread(scale, seen)


def spread(values: Tensor, seen: Tensor) -> Tensor:
    """Mean absolute deviation of B x T finite values from their row's mean, where seen is 1."""
    frames = seen.sum(1, keepdim=True).clamp(min=1)
    mean = (values * seen).sum(1, keepdim=True) / frames
    return (((values - mean).abs() * seen).sum(1) / frames[:, 0]).mean()
