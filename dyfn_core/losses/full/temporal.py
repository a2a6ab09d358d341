"""L_temp: how much points move from frame to frame, compared in magnitude (paper section 4)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from dyfn_core.losses.clip_alignment import ClipTarget


def temporal_loss(
    points: Tensor, target: ClipTarget, scale: Tensor, pairs: Sequence[tuple[int, int]]
) -> Tensor:
    """Mean of | s |p_i - p_j|_1 - |p*_i - p*_j|_1 | / z*_i over pixels valid in both frames.

    points: B x T x H x W x 3; scale: B, of the clips' alignment (clips of scale 0 do not count).
    pairs: (i, j), the frames to compare; the windows of the paper are j - i in {1, 2, 4}.
    Without pairs or common pixels the loss is 0.
    """
    if not pairs:
        return 0.0 * points.sum()  # with a graph, so that the loss alone can be trained on
    first = torch.tensor([pair[0] for pair in pairs], device=points.device)
    second = torch.tensor([pair[1] for pair in pairs], device=points.device)
    moved = (points[:, first] - points[:, second]).abs().sum(-1)
    truly = (target.points[:, first] - target.points[:, second]).abs().sum(-1)
    both = target.valid[:, first] & target.valid[:, second]
    both = both & (scale > 0)[:, None, None, None]
    error = (scale[:, None, None, None] * moved - truly).abs() * target.weight[:, first]
    return (error * both).sum() / both.sum().clamp(min=1)


def window_pairs(frames: Sequence[int], windows: Sequence[int]) -> list[tuple[int, int]]:
    """Positions (i, j) of frames whose numbers are one of the windows apart."""
    place = {frame: position for position, frame in enumerate(frames)}
    return [
        (position, place[frame + window])
        for position, frame in enumerate(frames)
        for window in windows
        if frame + window in place
    ]


def released_temporal_loss(
    points: Tensor,
    target: ClipTarget,
    scale: Tensor,
    windows: Sequence[int] = (1, 2, 4, 8),
) -> Tensor:
    """The released code's form: sum over windows of the error of the motion vectors.

    |s (p_j - p_{j+k}) - (p*_j - p*_{j+k})| over the mean depth of the pair, averaged over all
    coordinates and pixels, those not valid in both frames being 0. points: B x T x H x W x 3;
    scale: B, clips of scale 0 count 0. Windows that do not fit into the clip count 0 (the
    released code is NaN then).
    """
    loss = 0.0 * points.sum()  # with a graph also when no window fits
    true = target.points
    for window in windows:
        if window >= points.shape[1]:
            continue
        moved = scale[:, None, None, None, None] * (points[:, :-window] - points[:, window:])
        error = (moved - (true[:, :-window] - true[:, window:])).abs()
        both = target.valid[:, :-window] & target.valid[:, window:]
        both = both & (scale > 0)[:, None, None, None]
        depth = 0.5 * (true[:, :-window, ..., 2] + true[:, window:, ..., 2])
        loss = loss + (error * (both / depth)[..., None]).mean()
    return loss
