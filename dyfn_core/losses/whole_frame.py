"""The affine-invariant error of whole frames, MoGe's global term (paper section 4)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points_scale_z_shift
from dyfn_core.losses.target import Target

GRID = (10, 12)
ANCHORS = 16
LINEAR_TO = 1.0


def coarse_samples(target: Target, grid: tuple[int, int]) -> Tensor:
    """Indices into the flattened frame, B x N: in each cell of a grid, a valid pixel if any."""
    batch, height, width = target.valid.shape
    rows = ((torch.arange(grid[0]) + 0.5) * height / grid[0]).long()
    cols = ((torch.arange(grid[1]) + 0.5) * width / grid[1]).long()
    index = (rows[:, None] * width + cols[None, :]).flatten()
    return index.expand(batch, -1)


def pick(values: Tensor, index: Tensor) -> Tensor:
    """values B x H x W (x D) at flat indices B x N -> B x N (x D)."""
    flat = values.flatten(1, 2)
    if flat.dim() == 3:
        index = index[..., None].expand(-1, -1, flat.shape[-1])
    return flat.gather(1, index)


def align_frames(points: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """Scale (B) and z-shift (B x 3) of each frame on a coarse grid, weighted L1.

    Not truncated: the best (s, t) is then never worse than a constant, which bounds the loss
    while the prediction is still far off.

    The anchors are a subset of the grid's samples, drawn with torch's generator.
    """
    index = coarse_samples(target, GRID)
    anchors = torch.multinomial(torch.ones_like(index, dtype=torch.float), ANCHORS)
    return align_points_scale_z_shift(
        pick(points.detach(), index),
        pick(target.points, index),
        pick(target.weight(), index),
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
