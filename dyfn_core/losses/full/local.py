"""Errors inside balls around anchors, each ball with its own scale and shift (paper section 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.resample import nearest_valid, pick
from dyfn_core.losses.target import Target
from dyfn_core.losses.whole_frame import smooth

SIDE = 5  # samples along the side of the square in which a ball's points are looked for
FEWEST = 8  # balls with fewer valid samples are dropped
CANDIDATES = 4  # samples that the alignment may pass through
TRUNC = 1.0
FEWEST_IN_BALL = 32  # of ball_loss, which sees every pixel
NEIGHBOURS = 64
SCALE_RANGE = 10.0  # a ball's scale lies within this factor of the frame's


def local_loss(points: Tensor, target: Target, scale: Tensor, alpha: float, balls: int) -> Tensor:
    """Mean error of `balls` random balls per frame, of radius alpha * z * diagonal / (2 f).

    points: B x H x W x 3. scale: B, of the whole frames. Aligned by scale and xyz-shift.
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
        return pick(values, index.flatten(1)).unflatten(1, shape[1:])

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
    return torch.where(usable, per_ball, 0.0).sum() / usable.sum().clamp(min=1)


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


@dataclass(frozen=True)
class LocalLevel:
    """One level of MoGe's local term: balls of radius alpha * z * diagonal / (2 f).

    anchors: balls per frame. resolution: a ball is aligned on resolution x resolution samples.
    """

    alpha: float
    anchors: int
    resolution: int


# The paper's text, and the released training configuration.
TEXT_LEVELS = (LocalLevel(1 / 4, 16, 16), LocalLevel(1 / 16, 256, 8), LocalLevel(1 / 32, 4096, 4))
RELEASED_LEVELS = (*TEXT_LEVELS[:2], LocalLevel(1 / 64, 4096, 4))


def square_radius(alpha: float, size: tuple[int, int]) -> int:
    """Half the side, in pixels, of the square in which a ball's points are looked for."""
    return math.ceil(0.5 * alpha * math.hypot(*size))


def ball_radius(target: Target, alpha: float) -> Tensor:
    """The ball's radius around each pixel's true point, metres: B x H x W."""
    return 0.5 * alpha * target.points[..., 2] / target.focal[:, None, None]


def anchor_chance(target: Target, alpha: float, offsets: Tensor | None = None) -> Tensor:
    """How likely each pixel becomes an anchor, B x H x W: more so with few neighbours in its ball.

    Balances fine structures against walls. offsets: 2 x H x W x N row and column offsets of the
    neighbours that are looked at; None draws 64 a pixel with torch's generator.
    """
    height, width = target.valid.shape[-2:]
    if offsets is None:
        reach = square_radius(alpha, (height, width))
        offsets = torch.randint(
            -reach, reach + 1, (2, height, width, NEIGHBOURS), device=target.valid.device
        )
    rows = torch.arange(height, device=offsets.device)[:, None, None] + offsets[0]
    cols = torch.arange(width, device=offsets.device)[None, :, None] + offsets[1]
    inside = (rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)
    rows, cols = rows.clamp(0, height - 1), cols.clamp(0, width - 1)
    near = target.points[:, rows, cols] - target.points[..., None, :]
    near = near.norm(dim=-1) <= ball_radius(target, alpha)[..., None]
    count = (near & inside & target.valid[:, rows, cols]).float().sum(-1)
    chance = torch.where(target.valid, 1 / count.clamp(min=1), 0.0)
    return chance / chance.sum((-2, -1), keepdim=True).add(1e-7)


def draw_anchors(target: Target, level: LocalLevel, chance: Tensor | None = None) -> Tensor:
    """Flat pixel indices B x level.anchors, drawn with replacement; -1 in frames without truth."""
    if chance is None:
        chance = anchor_chance(target, level.alpha)
    empty = ~target.valid.flatten(1).any(1)
    chance = chance.flatten(1) + empty[:, None]
    drawn = torch.multinomial(chance, level.anchors, replacement=True)
    return torch.where(empty[:, None], -1, drawn)


def ball_loss(
    points: Tensor,
    target: Target,
    level: LocalLevel,
    scale: Tensor | None = None,
    anchors: Tensor | None = None,
    beta: float = 0.0,
) -> Tensor:
    """MoGe's local term at full resolution: B, the sum of the balls' errors over level.anchors.

    A ball holds every valid pixel of the square around its anchor whose true point is within its
    radius; those of fewer than FEWEST_IN_BALL pixels are dropped. Each is aligned by scale and
    xyz-shift (detached), its error is |s p + t - p*| / z* averaged over the square.
    points: B x H x W x 3. scale: B, the frames' own: balls whose scale is not within SCALE_RANGE
    of it are dropped; None asks for a positive scale only. anchors: as draw_anchors gives them,
    any number, -1 for none.
    """
    if anchors is None:
        anchors = draw_anchors(target, level)
    frame, place = torch.nonzero(anchors >= 0, as_tuple=True)
    centre = anchors[frame, place]
    balls = _balls(target, level, frame, centre)
    if not len(balls.frame):
        return (points * 0).sum((-3, -2, -1))
    predicted = points.flatten(1, 2)[balls.frame[:, None], balls.index]
    true = target.points.flatten(1, 2)[balls.frame[:, None], balls.index]
    ball_scale, ball_shift = _align_balls(predicted.detach(), true, balls, level.resolution)
    if scale is None:
        usable = ball_scale > 0
    else:
        own = scale[balls.frame]
        ratio = ball_scale / own.clamp(min=1e-12)
        usable = (ratio > 1 / SCALE_RANGE) & (ratio < SCALE_RANGE) & (own > 0)
    inverse = torch.where(target.valid, 1 / (target.points[..., 2] + 1e-7), 0.0)
    count = target.valid.float().mean((-2, -1))
    typical = 1 / (inverse.mean((-2, -1)) / (count + 1e-7) + 1e-7)
    weight = (balls.inside & usable[:, None]) / torch.maximum(
        true[..., 2], 0.1 * typical[balls.frame, None]
    )
    ball_scale = torch.where(usable, ball_scale, 0.0)
    ball_shift = torch.where(usable[:, None], ball_shift, 0.0)
    aligned = ball_scale[:, None, None] * predicted + ball_shift[:, None]
    error = smooth((aligned - true).abs() * weight[..., None], beta).mean((-2, -1))
    total = points.new_zeros(len(points)).index_add(0, balls.frame, error)
    return total / anchors.shape[1]


@dataclass(frozen=True)
class _Balls:
    """P balls: their frame (P), radius (P), square's side, its pixels (P x side^2: flat index,
    bool in the ball)."""

    frame: Tensor
    radius: Tensor
    side: int
    index: Tensor
    inside: Tensor


def _balls(target: Target, level: LocalLevel, frame: Tensor, centre: Tensor) -> _Balls:
    height, width = target.valid.shape[-2:]
    reach = square_radius(level.alpha, (height, width))
    offsets = torch.arange(-reach, reach + 1, device=centre.device)
    rows = (centre // width)[:, None, None] + offsets[:, None]
    cols = (centre % width)[:, None, None] + offsets[None, :]
    inside = ((rows >= 0) & (rows < height) & (cols >= 0) & (cols < width)).flatten(1)
    index = (rows.clamp(0, height - 1) * width + cols.clamp(0, width - 1)).flatten(1)
    radius = ball_radius(target, level.alpha).flatten(1)[frame, centre]
    points = target.points.flatten(1, 2)
    apart = points[frame[:, None], index] - points[frame, centre][:, None]
    inside = inside & target.valid.flatten(1)[frame[:, None], index]
    inside = inside & (apart.norm(dim=-1) <= radius[:, None])
    kept = inside.sum(-1) >= FEWEST_IN_BALL
    return _Balls(frame[kept], radius[kept], len(offsets), index[kept], inside[kept])


def _align_balls(
    predicted: Tensor, true: Tensor, balls: _Balls, resolution: int
) -> tuple[Tensor, Tensor]:
    square = balls.inside.unflatten(1, (balls.side, balls.side))
    index, seen = nearest_valid(square, (resolution, resolution))
    chosen = index[..., None].expand(-1, -1, 3)
    weight = seen / (balls.radius[:, None] + 1e-7)
    scale, shift = align_points(
        predicted.gather(1, chosen).double(),
        true.gather(1, chosen).double(),
        weight.double(),
        "xyz",
        TRUNC,
    )
    return scale.to(predicted), shift.to(predicted)
