"""How far points move between two frames, compared in magnitude: the core of L_temp."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyfn_core.losses.target import ClipTarget


def pair_motion_loss(
    points: Tensor, target: ClipTarget, scale: Tensor, pairs: Sequence[tuple[int, int]]
) -> Tensor:
    """Mean of (1 / z*_i) | s |p_i - p_j|_1 - |p*_i - p*_j|_1 | (paper section 4).

    Args:
        points: Predicted points, B x T x H x W x 3.
        target: The true geometry of the clips.
        scale: Scale of each clip's alignment, B; clips of scale 0 do not count.
        pairs: Positions (i, j) of the frames to compare.

    Returns:
        The mean over pixels that are valid in both frames; 0 without pairs or common pixels.
    """
    return pair_change_loss(points, target.points, target.valid, target.weight, scale, pairs)


def pair_change_loss(
    values: Tensor,
    truth: Tensor,
    valid: Tensor,
    weight: Tensor,
    scale: Tensor,
    pairs: Sequence[tuple[int, int]],
) -> Tensor:
    """Mean of w_i | s |v_i - v_j|_1 - |v*_i - v*_j|_1 |: L_temp of any quantity.

    Args:
        values: Predicted values, B x T x H x W x C.
        truth: True values, of the same shape.
        valid: Where the truth is known, B x T x H x W.
        weight: Of the error of the first frame of a pair, B x T x H x W.
        scale: Scale of each clip's alignment, B; clips of scale 0 do not count.
        pairs: Positions (i, j) of the frames to compare.

    Returns:
        The mean over pixels that are valid in both frames; 0 without pairs or common pixels.
    """
    if not pairs:
        return 0.0 * values.sum()  # with a graph, so that the loss alone can be trained on
    first = torch.tensor([pair[0] for pair in pairs], device=values.device)
    second = torch.tensor([pair[1] for pair in pairs], device=values.device)
    moved = (values[:, first] - values[:, second]).abs().sum(-1)
    truly = (truth[:, first] - truth[:, second]).abs().sum(-1)
    both = valid[:, first] & valid[:, second]
    both = both & (scale > 0)[:, None, None, None]
    error = (scale[:, None, None, None] * moved - truly).abs() * weight[:, first]
    return (error * both).sum() / both.sum().clamp(min=1)


def window_pairs(frames: Sequence[int], windows: Sequence[int]) -> list[tuple[int, int]]:
    """Find the frames that are one of the windows apart.

    Args:
        frames: Numbers of the frames that are at hand, in order.
        windows: Distances k of L_temp, in frames.

    Returns:
        Positions (i, j) in `frames` with frames[j] - frames[i] in `windows`.
    """
    place = {frame: position for position, frame in enumerate(frames)}
    return [
        (position, place[frame + window])
        for position, frame in enumerate(frames)
        for window in windows
        if frame + window in place
    ]
