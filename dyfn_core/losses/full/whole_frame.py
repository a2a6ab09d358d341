"""MoGe's global term: the affine-invariant error of whole frames (paper section 4)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.resample import nearest_valid, pick
from dyfn_core.losses.target import Target

SMALLEST_Z = 1e-2
MOST_WEIGHT = 10.0  # times the mean one: tiny true depths must not decide everything


def align_frames(
    points: Tensor, target: Target, resolution: int = 32, trunc: float = 1.0
) -> tuple[Tensor, Tensor]:
    """argmin_(s, t) sum_i min(trunc, (1 / z*_i) |s p_i + t - p*_i|_1), t along z (MoGe).

    Over a resolution x resolution grid of the valid pixels nearest to its cells' centres. All
    samples are anchors, in float64, detached.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.
        resolution: Side of the grid of samples.
        trunc: Weighted errors beyond this count as this.

    Returns:
        Scale, B, and shift, B x 3, of each frame; 0 where there is none.
    """
    index, seen = nearest_valid(target.valid, (resolution, resolution))
    return align_samples(
        pick(points.detach(), index), pick(target.points, index), seen, trunc, points.dtype
    )


def align_samples(
    points: Tensor, target: Tensor, seen: Tensor, trunc: float, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Align samples with weights 1 / z by scale and z-shift, exact, in float64.

    Args:
        points: Predicted points, B x N x 3.
        target: The true points, B x N x 3 metres.
        seen: Which samples count, B x N bool.
        trunc: Weighted errors beyond this count as this.
        dtype: Of what is returned.

    Returns:
        Scale, B, and shift, B x 3; both 0 where the best scale is not positive.
    """
    weight = seen / target[..., 2].clamp(min=SMALLEST_Z)
    scale, shift = align_points(points.double(), target.double(), weight.double(), "z", trunc)
    usable = scale > 0
    scale, shift = torch.where(usable, scale, 0.0), torch.where(usable[:, None], shift, 0.0)
    return scale.to(dtype), shift.to(dtype)


def global_loss(
    points: Tensor, target: Target, scale: Tensor, shift: Tensor, beta: float = 0.0
) -> Tensor:
    """L_global = mean_i (1 / z*_i) |s p_i + t - p*_i| under given alignments (MoGe).

    The mean is over all pixels and the three coordinates, invalid ones counting 0. A weight is at
    most MOST_WEIGHT times the frame's mean one.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.
        scale: Scale of each frame's alignment, B.
        shift: Its shift, B x 3.
        beta: Errors below it count squared.

    Returns:
        The loss of each frame, B; 0 for a frame of scale 0.
    """
    counts = target.valid & (scale > 0)[:, None, None]
    weight = counts / target.points[..., 2].clamp(min=1e-5)
    share = target.valid.float().mean((-2, -1), keepdim=True)
    usual = (weight * target.valid).mean((-2, -1), keepdim=True) / (share + 1e-7)
    weight = torch.minimum(weight, MOST_WEIGHT * usual)
    aligned = scale[:, None, None, None] * points + shift[:, None, None, :]
    error = (aligned - target.points).abs() * weight[..., None]
    return smooth(error, beta).mean((-3, -2, -1))


def smooth(error: Tensor, beta: float) -> Tensor:
    """Huber loss with slope 1: quadratic up to beta, then linear and beta / 2 lower.

    Args:
        error: Not negative, any shape.
        beta: Where the loss becomes linear; 0 for the error itself.

    Returns:
        The loss, of the same shape.
    """
    if beta == 0:
        return error
    return torch.where(error < beta, 0.5 * error.square() / beta, error - 0.5 * beta)
