"""L_temp: how much points move from frame to frame (paper section 4)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from dyfn_core.losses.motion import pair_motion_loss, window_pairs
from dyfn_core.losses.target import ClipTarget

FORMS = ("text", "released")


def temporal_loss(
    points: Tensor,
    target: ClipTarget,
    scale: Tensor,
    windows: Sequence[int] = (1, 2, 4),
    form: str = "text",
) -> Tensor:
    """L_temp = mean (1 / z*_i) | s |p_j - p_{j+k}|_1 - |p*_j - p*_{j+k}|_1 | (paper section 4).

    The released code compares vectors: sum_k mean |s (p_j - p_{j+k}) - (p*_j - p*_{j+k})| / z,
    with the mean depth z of the pair, over all pixels and coordinates, those that are not valid
    in both frames being 0.

    Args:
        points: Predicted points, B x T x H x W x 3.
        target: The true geometry of the clips.
        scale: Scale of each clip's alignment, B; clips of scale 0 do not count.
        windows: Distances k, in frames; the released code has 1, 2, 4 and 8.
        form: "text" for the paper's form, "released" for that of the released code.

    Returns:
        The mean over pixels that are valid in both frames (text), or the sum over windows
        (released). Windows that do not fit into the clip count 0; the released code is NaN then.
    """
    if form == "released":
        return _vector_loss(points, target, scale, windows)
    pairs = window_pairs(range(target.length), windows)
    return pair_motion_loss(points, target, scale, pairs)


def _vector_loss(
    points: Tensor, target: ClipTarget, scale: Tensor, windows: Sequence[int]
) -> Tensor:
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
