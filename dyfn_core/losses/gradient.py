"""Differences of the log-depth error between neighbours, at several scales: what makes edges."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.losses.target import Target

SCALES = 4


def gradient_loss(points: Tensor, target: Target, scales: int = SCALES) -> Tensor:
    """sum_k mean (|d_x R^k| + |d_y R^k|), R = log z - log z*; not of the paper.

    MiDaS' gradient matching term (Ranftl et al. 2020, eq. 11) on log depth, where no alignment is
    needed. R^k takes every 2^k-th row and column.

    Args:
        points: Predicted points, B x H x W x 3 with z > 0.
        target: The true geometry of the frames.
        scales: How many k, from 0 on.

    Returns:
        The sum of the means over pairs of valid neighbours; 0 without any.
    """
    truth = torch.where(target.valid, target.points[..., 2], 1.0)
    ratio = points[..., 2].log() - truth.log()
    total = ratio.new_zeros(())
    for scale in range(scales):
        step = 2**scale
        error, valid = ratio[:, ::step, ::step], target.valid[:, ::step, ::step]
        for axis in (1, 2):
            size = error.shape[axis]
            if size < 2:
                continue
            difference = error.narrow(axis, 1, size - 1) - error.narrow(axis, 0, size - 1)
            pairs = valid.narrow(axis, 1, size - 1) & valid.narrow(axis, 0, size - 1)
            total = total + torch.where(pairs, difference.abs(), 0.0).sum() / pairs.sum().clamp(
                min=1
            )
    return total
