"""The straightforward search of an alignment: through every sample, each solved by sorting."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_scale


def align_through_every_sample(
    points: Tensor, target: Tensor, weight: Tensor, shift: str, trunc: float
) -> tuple[Tensor, Tensor]:
    """What `align_points` does without anchors, one anchor after the other."""
    shifted = torch.full((points.shape[-1],), shift == "xyz")
    shifted[-1] = True
    weights = weight.repeat_interleave(points.shape[-1], dim=-1)
    scales, errors = [], []
    for anchor in range(points.shape[1]):
        x, y = (v - v[:, [anchor]] * shifted for v in (points, target))
        scale, error = align_scale(x.flatten(1), y.flatten(1), weights, trunc)
        scales.append(scale)
        errors.append(torch.where(weight[:, anchor] > 0, error, torch.inf))
    best = torch.stack(errors, 1).argmin(1)
    rows = torch.arange(len(points))
    usable = (weight > 0).any(1)
    scale = torch.where(usable, torch.stack(scales, 1)[rows, best], 0.0)
    moved = (target[rows, best] - scale[:, None] * points[rows, best]) * shifted
    return scale, torch.where(usable[:, None], moved, 0.0)
