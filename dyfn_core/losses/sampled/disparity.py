"""L_align and L_temp for models of disparity: the same errors, in disparity space (section 4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyfn_core.geometry.alignment import align_scale_shift
from dyfn_core.losses.motion import pair_change_loss
from dyfn_core.losses.sampled.clip_alignment import ANCHORS, TRUNC, coarse_sampler
from dyfn_core.losses.target import ClipTarget


def true_disparity(target: ClipTarget) -> tuple[Tensor, Tensor]:
    """The disparity to compare with, and its weight.

    Args:
        target: The true geometry of the clips.

    Returns:
        1 / z* and z*, which makes the errors relative, both B x T x H x W and 0 where invalid.
    """
    depth = torch.where(target.valid, target.points[..., 2], 1.0)
    return target.valid / depth, target.valid * depth


def align_disparity(disparity: Tensor, target: ClipTarget, mode: str) -> tuple[Tensor, Tensor]:
    """argmin_(s, t) sum_i min(1, z*_i |s d_i + t - 1 / z*_i|), on a coarse grid, detached.

    Args:
        disparity: Predicted disparity, B x T x H x W.
        target: The true geometry of the clips.
        mode: "first" fits to the first frame alone, "all" to samples of every frame.

    Returns:
        Scale and shift, B each; scale 0 where nothing can be aligned or the best scale is not
        positive.

    Raises:
        ValueError: For another mode.
    """
    sample = coarse_sampler(target, mode)
    truth, weight = (sample(values) for values in true_disparity(target))
    anchors = torch.multinomial(weight + 1e-9, ANCHORS)
    scale, shift = align_scale_shift(sample(disparity.detach()), truth, weight, TRUNC, anchors)
    usable = scale > 0
    return torch.where(usable, scale, 0.0), torch.where(usable, shift, 0.0)


def disparity_alignment_loss(
    disparity: Tensor, target: ClipTarget, scale: Tensor, shift: Tensor
) -> Tensor:
    """L_align in disparity space: mean_ji z*_ji |s d_ji + t - 1 / z*_ji| (paper section 4).

    Args:
        disparity: Predicted disparity, B x T x H x W.
        target: The true geometry of the clips.
        scale: Scale of each clip's alignment, B.
        shift: Its shift, B.

    Returns:
        The mean over clips with an alignment and a valid pixel; 0 without any.
    """
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
    """L_temp in disparity space: mean z*_i | s |d_i - d_j| - |1/z*_i - 1/z*_j| | (paper section 4).

    Args:
        disparity: Predicted disparity, B x T x H x W.
        target: The true geometry of the clips.
        scale: Scale of each clip's alignment, B; clips of scale 0 do not count.
        pairs: Positions (i, j) of the frames to compare.

    Returns:
        The mean over pixels that are valid in both frames; 0 without pairs or common pixels.
    """
    truth, weight = true_disparity(target)
    return pair_change_loss(
        disparity[..., None], truth[..., None], target.valid, weight, scale, pairs
    )
