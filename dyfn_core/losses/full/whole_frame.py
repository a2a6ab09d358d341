"""The affine-invariant error of whole frames, MoGe's global term (paper section 4)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.resample import nearest_valid, pick
from dyfn_core.losses.target import Target

GRID = (10, 12)
ANCHORS = 16
LINEAR_TO = 1.0
SMALLEST_Z = 1e-2
MOST_WEIGHT = 10.0  # times the mean one: tiny true depths must not decide everything


def coarse_samples(target: Target, grid: tuple[int, int]) -> Tensor:
    """Indices into the flattened frame, B x N: the middle of each cell of a grid."""
    batch, height, width = target.valid.shape
    rows = ((torch.arange(grid[0]) + 0.5) * height / grid[0]).long()
    cols = ((torch.arange(grid[1]) + 0.5) * width / grid[1]).long()
    index = (rows[:, None] * width + cols[None, :]).flatten()
    return index.to(target.valid.device).expand(batch, -1)


def align_frames(points: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """Scale (B) and z-shift (B x 3) of each frame on a coarse grid, weighted L1.

    Not truncated: the best (s, t) is then never worse than a constant, which bounds the loss
    while the prediction is still far off.

    The anchors are a subset of the grid's samples, drawn with torch's generator.
    """
    index = coarse_samples(target, GRID)
    anchors = torch.multinomial(torch.ones_like(index, dtype=torch.float), ANCHORS)
    return align_points(
        pick(points.detach(), index),
        pick(target.points, index),
        pick(target.weight(), index),
        "z",
        None,
        anchors,
    )


def whole_frame_loss(points: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """Mean over frames of mean_i |s p_i + t - p*_i|_1 / z*_i, one (s, t) per frame, detached.

    A pixel's error grows only logarithmically beyond LINEAR_TO.

    points: B x H x W x 3. Returns the loss and the scales (B); a frame whose best scale is not
    positive, or that has nothing valid, counts 0.
    """
    scale, shift = align_frames(points, target)
    usable = (scale > 0) & target.valid.flatten(1).any(1)
    aligned = scale[:, None, None, None] * points + shift[:, None, None, :]
    error = target.weight() * (aligned - target.points).abs().sum(-1)
    error = torch.where(
        error > LINEAR_TO, LINEAR_TO + torch.log(error.clamp(min=LINEAR_TO) / LINEAR_TO), error
    )
    count = target.valid.sum((1, 2)).clamp(min=1)
    per_frame = torch.where(usable, error.sum((1, 2)) / count, 0.0)
    return per_frame.mean(), scale


def align_frames_fully(
    points: Tensor, target: Target, resolution: int = 32, trunc: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Scale (B) and z-shift (B x 3) of each frame as MoGe finds them; 0 where there is none.

    Truncated L1 over a resolution x resolution grid of the valid pixels nearest to its cells'
    centres, weights 1 / z, exact over all anchors, in float64. points: B x H x W x 3.
    """
    index, seen = nearest_valid(target.valid, (resolution, resolution))
    return align_samples(
        pick(points.detach(), index), pick(target.points, index), seen, trunc, points.dtype
    )


def align_samples(
    points: Tensor, target: Tensor, seen: Tensor, trunc: float, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Samples B x N x 3 and where they count, B x N -> positive scales (B), z-shifts, else 0."""
    weight = seen / target[..., 2].clamp(min=SMALLEST_Z)
    scale, shift = align_points(points.double(), target.double(), weight.double(), "z", trunc)
    usable = scale > 0
    scale, shift = torch.where(usable, scale, 0.0), torch.where(usable[:, None], shift, 0.0)
    return scale.to(dtype), shift.to(dtype)


def aligned_frame_loss(
    points: Tensor, target: Target, scale: Tensor, shift: Tensor, beta: float = 0.0
) -> Tensor:
    """MoGe's global term under given alignments: B, the mean of |s p_i + t - p*_i| / z*_i.

    The mean is over all pixels and the three coordinates, invalid ones counting 0; a weight is at
    most MOST_WEIGHT times the frame's mean one. points: B x H x W x 3; scale B, shift B x 3.
    beta: errors below it count squared. A frame of scale 0 is 0.
    """
    counts = target.valid & (scale > 0)[:, None, None]
    weight = counts / target.points[..., 2].clamp(min=1e-5)
    share = target.valid.float().mean((-2, -1), keepdim=True)
    usual = (weight * target.valid).mean((-2, -1), keepdim=True) / (share + 1e-7)
    weight = torch.minimum(weight, MOST_WEIGHT * usual)
    aligned = scale[:, None, None, None] * points + shift[:, None, None, :]
    error = (aligned - target.points).abs() * weight[..., None]
    return smooth(error, beta).mean((-3, -2, -1))


def sparsity_weight(target: Target, resolution: int) -> Tensor:
    """B: what a frame's loss is multiplied by so that sparse truth counts like dense truth."""
    seen = nearest_valid(target.valid, (resolution, resolution))[1].float().mean(-1)
    return 1 / (target.valid.float().mean((-2, -1)) / seen.clamp(min=1e-7) + 1e-7)


def smooth(error: Tensor, beta: float) -> Tensor:
    """error >= 0 -> quadratic up to beta, then linear and beta / 2 lower."""
    if beta == 0:
        return error
    return torch.where(error < beta, 0.5 * error.square() / beta, error - 0.5 * beta)
