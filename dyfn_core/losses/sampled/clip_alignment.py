"""L_align: the error of a whole clip under one scale and shift (paper section 4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_points
from dyfn_core.losses.resample import nearest_valid, pick
from dyfn_core.losses.target import Target
from dyfn_core.losses.whole_frame import align_samples, coarse_samples

FIRST_GRID = (10, 12)
ALL_GRID = (6, 8)
ANCHORS = 24
TRUNC = 1.0
SMALLEST_ERROR = 0.02  # relative errors below this weigh alike in the differentiable fit


@dataclass(frozen=True)
class ClipTarget:
    """The true geometry of B clips of T frames; `frames` has them all, B * T in that order."""

    frames: Target
    length: int

    @property
    def valid(self) -> Tensor:
        """B x T x H x W bool."""
        return self.frames.valid.unflatten(0, (-1, self.length))

    @property
    def points(self) -> Tensor:
        """B x T x H x W x 3 metres."""
        return self.frames.points.unflatten(0, (-1, self.length))

    @property
    def weight(self) -> Tensor:
        """B x T x H x W: 1 / z where valid, else 0."""
        return self.frames.weight().unflatten(0, (-1, self.length))


def align_clips(
    points: Tensor, target: ClipTarget, mode: str, differentiable: bool = False
) -> tuple[Tensor, Tensor]:
    """One scale (B) and z-shift (B x 3) per clip; scale 0 where nothing can be aligned.

    points: B x T x H x W x 3. mode: "first" fits them to the first frame alone, "all" to samples
    of every frame. differentiable: gradients flow through scale and shift; else, as in the
    paper, they do not. Detached, the gradient of an error under the first frame's alignment is
    not that of the error: changing the first frame moves all others. Raises ValueError on
    another mode.
    """
    check_mode(mode)
    frames = 1 if mode == "first" else target.length
    index = coarse_samples(target.frames, FIRST_GRID if mode == "first" else ALL_GRID)[:1]

    def sample(values: Tensor) -> Tensor:
        chosen = values[:, :frames].flatten(0, 1)
        return pick(chosen, index.expand(len(chosen), -1)).unflatten(0, (-1, frames)).flatten(1, 2)

    weight = sample(target.weight)
    anchors = torch.multinomial(weight + 1e-9, ANCHORS)
    scale, shift = align_points(
        sample(points.detach()), sample(target.points), weight, "z", TRUNC, anchors
    )
    if differentiable:
        scale, shift = _least_squares(sample(points), sample(target.points), weight, scale, shift)
    usable = scale > 0
    return torch.where(usable, scale, 0.0), torch.where(usable[:, None], shift, 0.0)


def align_clips_fully(
    points: Tensor, target: ClipTarget, mode: str, resolution: int = 32, trunc: float = 1.0
) -> tuple[Tensor, Tensor]:
    """As align_clips, by MoGe's sampling and all its anchors; detached, in float64.

    The clips' frames are sampled on a resolution x resolution grid each: with mode "all" the cost
    grows with the square of their number, and the released code takes a resolution of 8 there.
    """
    check_mode(mode)
    frames = 1 if mode == "first" else target.length
    valid = target.valid[:, :frames]
    index, seen = nearest_valid(valid.flatten(0, 1), (resolution, resolution))

    def sample(values: Tensor) -> Tensor:
        chosen = pick(values[:, :frames].flatten(0, 1), index)
        return chosen.unflatten(0, (-1, frames)).flatten(1, 2)

    seen = seen.unflatten(0, (-1, frames)).flatten(1)
    return align_samples(sample(points.detach()), sample(target.points), seen, trunc, points.dtype)


def check_mode(mode: str) -> None:
    """Raises ValueError that names the modes for another one."""
    if mode not in ("first", "all"):
        raise ValueError(f"alignment mode must be 'first' or 'all', got {mode!r}")


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


def clip_alignment_loss(points: Tensor, target: ClipTarget, scale: Tensor, shift: Tensor) -> Tensor:
    """Mean over clips of mean_ji |s p_ji + t - p*_ji|_1 / z*_ji over valid pixels.

    points: B x T x H x W x 3; scale B and shift B x 3 from align_clips. A clip without an
    alignment, or without a valid pixel, contributes nothing.
    """
    aligned = scale[:, None, None, None, None] * points + shift[:, None, None, None, :]
    error = target.weight * (aligned - target.points).abs().sum(-1)
    count = target.valid.sum((1, 2, 3))
    usable = (scale > 0) & (count > 0)
    per_clip = torch.where(usable, error.sum((1, 2, 3)) / count.clamp(min=1), 0.0)
    return per_clip.sum() / usable.sum().clamp(min=1)
