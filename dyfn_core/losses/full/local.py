"""L_local: errors inside balls, each with its own scale and shift (paper section 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.full.whole_frame import smooth
from dyfn_core.losses.resample import nearest_valid
from dyfn_core.losses.target import Target

TRUNC = 1.0
FEWEST = 32  # balls with fewer valid pixels are dropped by the released code
LEAST = 8  # and by the rule for small images; an alignment has four unknowns
FULL = 3  # that rule: a ball has a third of the pixels of a disc that faces the camera
NEIGHBOURS = 64
SCALE_RANGE = 10.0  # a ball's scale lies within this factor of the frame's


@dataclass(frozen=True)
class LocalLevel:
    """One level of L_local: balls of radius alpha z sqrt(W^2 + H^2) / (2 f) around anchors.

    Attributes:
        alpha: Radius of the balls relative to what the image spans at their depth.
        anchors: Balls per frame.
        resolution: A ball is aligned on resolution x resolution samples.
        fewest: Balls of fewer valid pixels are dropped. None goes by the image's size: a third of
            the pixels that a ball facing the camera has, between 8 and 32. The released code has
            32, which only images of half a megapixel have in balls of alpha 1/64.
    """

    alpha: float
    anchors: int
    resolution: int
    fewest: int | None = None

    def fewest_at(self, size: tuple[int, int]) -> int:
        """Find how many valid pixels a ball must have.

        Args:
            size: Height and width of the image in pixels.

        Returns:
            The number of pixels.
        """
        if self.fewest is not None:
            return self.fewest
        disc = math.pi * (0.5 * self.alpha * math.hypot(*size)) ** 2
        return min(FEWEST, max(LEAST, math.ceil(disc / FULL)))

    def check_size(self, size: tuple[int, int]) -> None:
        """Refuse images in which no ball has enough pixels.

        Args:
            size: Height and width of the image in pixels.

        Raises:
            ValueError: Names the smallest size of that aspect.
        """
        needed = self.fewest_at(size)
        if _pixels_within(0.5 * self.alpha * math.hypot(*size)) >= needed:
            return
        radius = next(r for r in (n**0.5 for n in range(1, 10_000)) if _pixels_within(r) >= needed)
        factor = 2 * radius / self.alpha / math.hypot(*size)
        raise ValueError(
            f"L_local of alpha 1/{1 / self.alpha:g}: no ball of an image of {size[0]} x {size[1]} "
            f"has {needed} pixels; the smallest image of that shape is "
            f"{math.ceil(size[0] * factor)} x {math.ceil(size[1] * factor)}"
        )


TEXT_LEVELS = (LocalLevel(1 / 4, 16, 16), LocalLevel(1 / 16, 256, 8), LocalLevel(1 / 32, 4096, 4))
RELEASED_LEVELS = (
    LocalLevel(1 / 4, 16, 16, FEWEST),
    LocalLevel(1 / 16, 256, 8, FEWEST),
    LocalLevel(1 / 64, 4096, 4, FEWEST),
)


def _pixels_within(radius: float) -> int:
    """How many pixels have their centre within a radius of a pixel's, in pixels."""
    reach = math.floor(radius)
    steps = range(-reach, reach + 1)
    return sum(row * row + col * col <= radius * radius + 1e-9 for row in steps for col in steps)


def square_radius(alpha: float, size: tuple[int, int]) -> int:
    """Find how far from its anchor a ball's points are looked for.

    Args:
        alpha: Radius of the ball, see LocalLevel.
        size: Height and width of the image in pixels.

    Returns:
        Half the side of the square, in pixels.
    """
    return math.ceil(0.5 * alpha * math.hypot(*size))


def ball_radius(target: Target, alpha: float) -> Tensor:
    """alpha z sqrt(W^2 + H^2) / (2 f) around each pixel's true point (paper section 4).

    Args:
        target: The true geometry of the frames.
        alpha: See LocalLevel.

    Returns:
        The radius, B x H x W metres.
    """
    return 0.5 * alpha * target.points[..., 2] / target.focal[:, None, None]


def anchor_chance(target: Target, alpha: float, offsets: Tensor | None = None) -> Tensor:
    """Find how likely each pixel becomes an anchor: more so with few neighbours in its ball.

    Balances fine structures against walls.

    Args:
        target: The true geometry of the frames.
        alpha: See LocalLevel.
        offsets: Row and column offsets of the neighbours that are looked at, 2 x H x W x N; None
            draws NEIGHBOURS a pixel with torch's generator.

    Returns:
        Chances, B x H x W; they add up to 1 in frames with a valid pixel.
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
    index = (rows * width + cols).flatten()
    apart = torch.zeros(len(target.valid), *rows.shape, device=rows.device)
    for axis in target.points.unbind(-1):
        step = axis.flatten(1)[:, index].view_as(apart) - axis[..., None]
        apart = torch.addcmul(apart, step, step)
    near = apart <= ball_radius(target, alpha)[..., None].square()
    valid = target.valid.flatten(1)[:, index].view_as(near)
    count = (near & inside & valid).float().sum(-1)
    chance = torch.where(target.valid, 1 / count.clamp(min=1), 0.0)
    return chance / chance.sum((-2, -1), keepdim=True).add(1e-7)


def draw_anchors(target: Target, level: LocalLevel, chance: Tensor | None = None) -> Tensor:
    """Draw anchors with replacement.

    Args:
        target: The true geometry of the frames.
        level: Size and number of the balls.
        chance: As anchor_chance gives it; None for what it gives.

    Returns:
        Flat pixel indices, B x level.anchors; -1 in frames without a valid pixel.
    """
    if chance is None:
        chance = anchor_chance(target, level.alpha)
    empty = ~target.valid.flatten(1).any(1)
    chance = chance.flatten(1) + empty[:, None]
    drawn = torch.multinomial(chance, level.anchors, replacement=True)
    return torch.where(empty[:, None], -1, drawn)


def local_loss(
    points: Tensor,
    target: Target,
    scale: Tensor | None,
    level: LocalLevel,
    anchors: Tensor | None = None,
    beta: float = 0.0,
) -> Tensor:
    """L_local = sum_a mean_i (1 / z*_i) |s_a p_i + t_a - p*_i|_1 / anchors (paper section 4; MoGe).

    The ball of anchor a holds every valid pixel i of the square around it whose true point is
    within the ball's radius; balls of fewer than `level.fewest` pixels are dropped. s_a and t_a,
    along all three axes, minimise the ball's truncated error and are detached. The mean is over the
    square and the three coordinates.

    Args:
        points: Predicted points, B x H x W x 3.
        target: The true geometry of the frames.
        scale: Scale of each frame's own alignment, B: balls whose scale is not within SCALE_RANGE
            of it are dropped. None asks for a positive scale only.
        level: Size and number of the balls.
        anchors: Flat pixel indices, B x any number, -1 where there is no anchor; None draws
            them with `draw_anchors`.
        beta: Errors below it count squared.

    Returns:
        The loss of each frame, B.
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
    kept = inside.sum(-1) >= level.fewest_at((height, width))
    return _Balls(frame[kept], radius[kept], len(offsets), index[kept], inside[kept])


def _align_balls(
    predicted: Tensor, true: Tensor, balls: _Balls, resolution: int
) -> tuple[Tensor, Tensor]:
    square = torch.unflatten(balls.inside, 1, (balls.side, balls.side))
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
