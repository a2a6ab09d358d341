"""L_align and L_temp for models of disparity: the same errors, in disparity space (section 4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_scale_shift
from dyfn_core.losses.clip_alignment import (
    ALL_GRID,
    ANCHORS,
    FIRST_GRID,
    TRUNC,
    ClipTarget,
    check_mode,
)
from dyfn_core.losses.resample import pick
from dyfn_core.losses.whole_frame import coarse_samples


def true_disparity(target: ClipTarget) -> tuple[Tensor, Tensor]:
    """1 / z* and the weight z* that makes its errors relative, 0 where invalid: B x T x H x W."""
    depth = torch.where(target.valid, target.points[..., 2], 1.0)
    return target.valid / depth, target.valid * depth


def align_disparity(disparity: Tensor, target: ClipTarget, mode: str) -> tuple[Tensor, Tensor]:
    """One scale and shift (B each) per clip that bring B x T x H x W disparity to 1 / z*.

    mode: "first" or "all", as for points; detached. Scale 0 where nothing can be aligned or the
    best scale is not positive. Raises ValueError on another mode.
    """
    check_mode(mode)
    frames = 1 if mode == "first" else target.length
    index = coarse_samples(target.frames, FIRST_GRID if mode == "first" else ALL_GRID)[:1]

    def sample(values: Tensor) -> Tensor:
        chosen = values[:, :frames].flatten(0, 1)
        return pick(chosen, index.expand(len(chosen), -1)).unflatten(0, (-1, frames)).flatten(1)

    truth, weight = (sample(values) for values in true_disparity(target))
    anchors = torch.multinomial(weight + 1e-9, ANCHORS)
    scale, shift = align_scale_shift(sample(disparity.detach()), truth, weight, TRUNC, anchors)
    usable = scale > 0
    return torch.where(usable, scale, 0.0), torch.where(usable, shift, 0.0)


def disparity_alignment_loss(
    disparity: Tensor, target: ClipTarget, scale: Tensor, shift: Tensor
) -> Tensor:
    """Mean over clips of mean_ji z*_ji |s d_ji + t - 1 / z*_ji|: B x T x H x W, scale, shift B."""
    truth, weight = true_disparity(target)
    aligned = scale[:, None, None, None] * disparity + shift[:, None, None, None]
    error = weight * (aligned - truth).abs()
    count = target.valid.sum((1, 2, 3))
    usable = (scale > 0) & (count > 0)
    per_clip = torch.where(usable, error.sum((1, 2, 3)) / count.clamp(min=1), 0.0)
    return per_clip.sum() / usable.sum().clamp(min=1)


def disparity_temporal_loss(
    disparity: Tensor, target: ClipTarget, scale: Tensor, pairs: Sequence[tuple[int, int]]
) -> Tensor:
    """Mean of z*_i | s |d_i - d_j| - |1/z*_i - 1/z*_j| | over pixels valid in both frames.

    disparity: B x T x H x W; scale: B, of the clips' alignment (clips of scale 0 do not count).
    pairs: (i, j), the frames to compare. Without pairs or common pixels the loss is 0.
    """
    if not pairs:
        return (disparity * 0).sum()
    first = torch.tensor([pair[0] for pair in pairs], device=disparity.device)
    second = torch.tensor([pair[1] for pair in pairs], device=disparity.device)
    truth, weight = true_disparity(target)
    moved = (disparity[:, first] - disparity[:, second]).abs()
    truly = (truth[:, first] - truth[:, second]).abs()
    both = target.valid[:, first] & target.valid[:, second]
    both = both & (scale > 0)[:, None, None, None]
    error = (scale[:, None, None, None] * moved - truly).abs() * weight[:, first]
    return (error * both).sum() / both.sum().clamp(min=1)
