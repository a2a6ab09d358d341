"""The scale and shift of L_align on a coarse grid, differentiable on request."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.clip_alignment import check_mode
from dyfn_core.losses.resample import pick
from dyfn_core.losses.sampled.whole_frame import coarse_samples
from dyfn_core.losses.target import ClipTarget

FIRST_GRID = (10, 12)
ALL_GRID = (6, 8)
ANCHORS = 24
TRUNC = 1.0
SMALLEST_ERROR = 0.02  # relative errors below this weigh alike in the differentiable fit


def align_clips(
    points: Tensor, target: ClipTarget, mode: str, differentiable: bool = False
) -> tuple[Tensor, Tensor]:
    """argmin_(s, t) sum_i min(1, (1 / z*_i) |s p_i + t - p*_i|_1), t along z (paper section 4).

    On a coarse grid, the best that pass through one of ANCHORS samples. Detached, as in the paper,
    the gradient of an error under the first frame's alignment is not that of the error: changing
    the first frame moves all others.

    Args:
        points: Predicted points, B x T x H x W x 3.
        target: The true geometry of the clips.
        mode: "first" fits to the first frame alone, "all" to samples of every frame.
        differentiable: Whether gradients flow through scale and shift.

    Returns:
        Scale, B, and shift, B x 3; scale 0 where nothing can be aligned.

    Raises:
        ValueError: For another mode.
    """
    sample = coarse_sampler(target, mode)
    weight = sample(target.weight)
    anchors = torch.multinomial(weight + 1e-9, ANCHORS)
    scale, shift = align_points(
        sample(points.detach()), sample(target.points), weight, "z", TRUNC, anchors
    )
    if differentiable:
        scale, shift = _least_squares(sample(points), sample(target.points), weight, scale, shift)
    usable = scale > 0
    return torch.where(usable, scale, 0.0), torch.where(usable[:, None], shift, 0.0)


def coarse_sampler(target: ClipTarget, mode: str) -> Callable[[Tensor], Tensor]:
    """What takes the samples of a clip's alignment out of B x T x H x W (x C) values.

    Args:
        target: The true geometry of the clips, which says where there are samples.
        mode: "first" samples the first frame alone, "all" every frame more coarsely.

    Returns:
        A function that gives the samples, B x N (x C).

    Raises:
        ValueError: For another mode.
    """
    check_mode(mode)
    frames = 1 if mode == "first" else target.length
    index = coarse_samples(target.frames, FIRST_GRID if mode == "first" else ALL_GRID)[:1]

    def sample(values: Tensor) -> Tensor:
        chosen = values[:, :frames].flatten(0, 1)
        picked = pick(chosen, index.expand(len(chosen), -1))
        return torch.unflatten(picked, 0, (-1, frames)).flatten(1, 2)

    return sample


def _least_squares(
    points: Tensor, target: Tensor, weight: Tensor, scale: Tensor, shift: Tensor
) -> tuple[Tensor, Tensor]:
    """The truncated L1 fit again, as the weighted least squares problem that it solves.

    Weighting every coordinate by its inverse residual makes least squares agree with L1; the
    weights are constants, the solution is differentiable in the points. B x N x 3 each.
    """
    residual = (scale[:, None, None] * points + shift[:, None] - target).detach().abs()
    error = residual * weight[..., None]
    trusted = weight[..., None] / residual.clamp(min=1e-9)
    trusted = torch.minimum(trusted, weight[..., None].square() / SMALLEST_ERROR)
    trusted = torch.where(error < TRUNC, trusted, 0.0)
    vz, z, true_z = trusted[..., 2], points[..., 2], target[..., 2]
    total = vz.sum(1).clamp(min=1e-12)
    mean_z, mean_true = (vz * z).sum(1) / total, (vz * true_z).sum(1) / total
    centred = torch.cat([points[..., :2], (z - mean_z[:, None])[..., None]], -1)
    goal = torch.cat([target[..., :2], (true_z - mean_true[:, None])[..., None]], -1)
    power = (trusted * centred.square()).sum((1, 2)).clamp(min=1e-12)
    solved = (trusted * centred * goal).sum((1, 2)) / power
    usable = scale > 0
    solved = torch.where(usable, solved, 0.0)
    zero = torch.zeros_like(solved)
    return solved, torch.stack([zero, zero, mean_true - solved * mean_z], dim=-1)
