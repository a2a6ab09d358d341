"""L_local on a few samples of a few random balls."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.full.local import SCALE_RANGE, TRUNC
from dyfn_core.losses.resample import pick
from dyfn_core.losses.target import Target

SIDE = 5  # samples along the side of the square in which a ball's points are looked for
FEWEST = 8  # balls with fewer valid samples are dropped
CANDIDATES = 4  # samples that the alignment may pass through


def local_loss(points: Tensor, target: Target, scale: Tensor, alpha: float, balls: int) -> Tensor:
    """L_local = mean_a mean_i (1 / z*_i) |s_a p_i + t_a - p*_i|_1 (paper section 4).

    The ball of anchor a has the radius alpha z sqrt(W^2 + H^2) / (2 f); SIDE x SIDE pixels of the
    square around the anchor are looked at. s_a and t_a, along all three axes, are the best that
    pass through one of CANDIDATES samples, detached.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.
        scale: Scale of each frame's own alignment, B: balls whose scale is not within SCALE_RANGE
            of it are dropped.
        alpha: Radius of the balls relative to what the image spans at their depth.
        balls: Anchors of each frame, drawn with torch's generator.

    Returns:
        The mean over the balls of the batch that count; 0 without any.
    """
    height, width = target.valid.shape[1:]
    diagonal = (height**2 + width**2) ** 0.5
    reach = alpha * diagonal / 2
    weight = target.weight()
    chance = target.valid.flatten(1).float() + 1e-9
    centre = torch.multinomial(chance, balls)
    offsets = torch.linspace(-reach, reach, SIDE).trunc().long()
    rows = (centre // width)[..., None, None] + offsets[:, None]
    cols = (centre % width)[..., None, None] + offsets[None, :]
    outside = (rows < 0) | (rows >= height) | (cols < 0) | (cols >= width)
    index = rows.clamp(0, height - 1) * width + cols.clamp(0, width - 1)
    index, outside = index.flatten(2), outside.flatten(2)
    shape = index.shape

    def gather(values: Tensor) -> Tensor:
        return torch.unflatten(pick(values, index.flatten(1)), 1, shape[1:])

    true, predicted, weights = gather(target.points), gather(points), gather(weight)
    middle = SIDE * SIDE // 2
    radius = alpha * true[:, :, middle, 2] / (2 * target.focal[:, None])
    distance = (true - true[:, :, middle : middle + 1]).norm(dim=-1)
    weights = weights * (~outside & (distance <= radius[..., None]))
    counted = (weights > 0).flatten(0, 1)
    ball_scale, ball_shift = _align(predicted, true, weights)
    ratio = ball_scale / scale.repeat_interleave(balls).clamp(min=1e-12)
    usable = (counted.sum(-1) >= FEWEST) & (ratio > 1 / SCALE_RANGE) & (ratio < SCALE_RANGE)
    aligned = ball_scale[:, None, None] * predicted.flatten(0, 1) + ball_shift[:, None, :]
    error = weights.flatten(0, 1) * (aligned - true.flatten(0, 1)).abs().sum(-1)
    per_ball = error.sum(-1) / counted.sum(-1).clamp(min=1)
    loss: Tensor = torch.where(usable, per_ball, 0.0).sum() / usable.sum().clamp(min=1)
    return loss


def _align(predicted: Tensor, true: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The centre and a few random samples are the anchors."""
    count = predicted.shape[0] * predicted.shape[1]
    chance = weights.detach().flatten(0, 1) + 1e-12
    anchors = torch.multinomial(chance, CANDIDATES - 1)
    middle = torch.full((count, 1), SIDE * SIDE // 2, device=anchors.device)
    return align_points(
        predicted.detach().flatten(0, 1),
        true.flatten(0, 1),
        weights.flatten(0, 1),
        "xyz",
        TRUNC,
        torch.cat([middle, anchors], dim=1),
    )
