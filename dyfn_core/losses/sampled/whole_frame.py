"""MoGe's global term on a coarse grid: the affine-invariant error of whole frames."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.resample import pick
from dyfn_core.losses.target import Target

GRID = (10, 12)
ANCHORS = 16
LINEAR_TO = 1.0


def coarse_samples(target: Target, grid: tuple[int, int]) -> Tensor:
    """Sample every frame alike.

    Args:
        target: The true geometry of the frames.
        grid: Rows and columns of samples.

    Returns:
        Indices into the flattened frame, B x N: the middle of each cell of the grid.
    """
    batch, height, width = target.valid.shape
    rows = ((torch.arange(grid[0]) + 0.5) * height / grid[0]).long()
    cols = ((torch.arange(grid[1]) + 0.5) * width / grid[1]).long()
    index = (rows[:, None] * width + cols[None, :]).flatten()
    return index.to(target.valid.device).expand(batch, -1)


def align_frames(points: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """argmin_(s, t) sum_i (1 / z*_i) |s p_i + t - p*_i|_1, t along z, on a coarse grid.

    Not truncated: the best (s, t) is then never worse than a constant, which bounds the loss
    while the prediction is still far off. The anchors are a subset of the grid's samples, drawn
    with torch's generator. Detached.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.

    Returns:
        Scale, B, and shift, B x 3, of each frame; a scale that is not positive is no alignment.
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


def global_loss(points: Tensor, target: Target, scale: Tensor, shift: Tensor) -> Tensor:
    """L_global = mean_i (1 / z*_i) |s p_i + t - p*_i|_1 over valid pixels (MoGe).

    A pixel's error grows only logarithmically beyond LINEAR_TO.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.
        scale: Scale of each frame's alignment, B.
        shift: Its shift, B x 3.

    Returns:
        The mean over frames; one without a positive scale or without a valid pixel counts 0.
    """
    usable = (scale > 0) & target.valid.flatten(1).any(1)
    aligned = scale[:, None, None, None] * points + shift[:, None, None, :]
    error = target.weight() * (aligned - target.points).abs().sum(-1)
    error = torch.where(
        error > LINEAR_TO, LINEAR_TO + torch.log(error.clamp(min=LINEAR_TO) / LINEAR_TO), error
    )
    count = target.valid.sum((1, 2)).clamp(min=1)
    per_frame = torch.where(usable, error.sum((1, 2)) / count, 0.0)
    return per_frame.mean()
