"""L_normal from one corner of every quad of pixels, at any distance."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dyfn_core.losses.full.normal import HUBER, LARGEST, SMALLEST
from dyfn_core.losses.target import Target


def normal_loss(points: Tensor, target: Target, stride: int = 1) -> Tensor:
    """L_normal = mean_i huber(angle(n_i, n*_i)), angles clamped to 1..90 degrees (paper section 4).

    Normals are cross products of the differences to the right and lower neighbour, which no scale
    or shift changes. The Huber loss is linear above 3 degrees, with slope 1.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.
        stride: Distance of the neighbours in pixels; over one pixel the gradient is mostly the
            prediction's noise, until that is very small.

    Returns:
        The mean over the quads of valid neighbours of the batch; 0 without any.
    """
    ours, theirs = (_normals(p[:, ::stride, ::stride]) for p in (points, target.points))
    known = target.valid[:, ::stride, ::stride]
    valid = known[:, :-1, :-1] & known[:, 1:, :-1] & known[:, :-1, 1:]
    # atan2 keeps a useful gradient at small angles, where acos has none.
    sine = torch.linalg.cross(ours, theirs).square().sum(-1).add(1e-12).sqrt()
    angle = torch.atan2(sine, (ours * theirs).sum(-1)).clamp(SMALLEST, LARGEST)
    loss = F.huber_loss(angle, torch.zeros_like(angle), reduction="none", delta=HUBER) / HUBER
    return (loss * valid).sum() / valid.sum().clamp(min=1)


def _normals(points: Tensor) -> Tensor:
    corner = points[:, :-1, :-1]
    down, right = points[:, 1:, :-1] - corner, points[:, :-1, 1:] - corner
    return F.normalize(torch.linalg.cross(down, right), dim=-1, eps=1e-12)
