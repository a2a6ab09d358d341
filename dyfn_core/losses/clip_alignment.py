"""L_align: the error of a whole clip under one scale and shift (paper section 4)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.losses.target import ClipTarget


def check_mode(mode: str) -> None:
    """Check which frames an alignment is fitted to.

    Args:
        mode: "first" for the first frame of a clip, "all" for every frame.

    Raises:
        ValueError: For any other mode; the message names the two.
    """
    if mode not in ("first", "all"):
        raise ValueError(f"alignment mode must be 'first' or 'all', got {mode!r}")


def clip_alignment_loss(points: Tensor, target: ClipTarget, scale: Tensor, shift: Tensor) -> Tensor:
    """L_align = mean_ji (1 / z_i) |s_g p_ji + t_g - p*_ji|_1 over valid pixels (paper section 4).

    A clip without an alignment, or without a valid pixel, contributes nothing.

    Args:
        points: Predicted points, B x T x H x W x 3.
        target: The true geometry of the clips.
        scale: s_g of each clip, B; 0 where nothing could be aligned.
        shift: t_g of each clip, B x 3.

    Returns:
        The mean over the clips that contribute; 0 without any.
    """
    aligned = scale[:, None, None, None, None] * points + shift[:, None, None, None, :]
    error = target.weight * (aligned - target.points).abs().sum(-1)
    count = target.valid.sum((1, 2, 3))
    usable = (scale > 0) & (count > 0)
    per_clip = torch.where(usable, error.sum((1, 2, 3)) / count.clamp(min=1), 0.0)
    return per_clip.sum() / usable.sum().clamp(min=1)
