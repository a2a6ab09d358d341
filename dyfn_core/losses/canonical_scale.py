"""A weak pull of every frame's scale towards its true, focal-normalised one.

The paper's base has no such term: its loss is blind to scale, and whatever scale a frame comes out
with is an accident. A small encoder then normalises each frame by its own mean depth and keeps
nothing in the latent from which a recurrence could tell that the camera came closer. How large
things look determines depth over focal length, which one camera's frames share up to one factor.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from dyfn_core.losses.target import Target

HUBER = 0.3


def canonical_scale_loss(points: Tensor, target: Target) -> Tensor:
    """mean_j huber(mean_i (log z_i - log(z*_i / f))); not of the paper.

    The focal length f is in units of the image's diagonal. The Huber loss is linear above HUBER,
    with slope 1.

    Args:
        points: Predicted points after the remap, B x H x W x 3 with z > 0.
        target: The true geometry of the frames.

    Returns:
        The mean over frames; one without a valid pixel counts 0.
    """
    truth = torch.where(target.valid, target.points[..., 2], 1.0)
    ratio = points[..., 2].log() - (truth / target.focal[:, None, None]).log()
    count = target.valid.sum((1, 2))
    mean = torch.where(target.valid, ratio, 0.0).sum((1, 2)) / count.clamp(min=1)
    return F.huber_loss(mean, torch.zeros_like(mean), delta=HUBER) / HUBER
