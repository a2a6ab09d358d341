"""L_temp between the decoded ones of a clip's frames (paper section 4)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from dyfn_core.losses.motion import pair_motion_loss, window_pairs
from dyfn_core.losses.target import ClipTarget


def temporal_loss(
    points: Tensor,
    target: ClipTarget,
    scale: Tensor,
    windows: Sequence[int],
    frames: Sequence[int],
) -> Tensor:
    """L_temp = mean (1 / z*_i) | s |p_j - p_{j+k}|_1 - |p*_j - p*_{j+k}|_1 | (paper section 4).

    Args:
        points: Predicted points of the decoded frames, B x T x H x W x 3.
        target: Their true geometry.
        scale: Scale of each clip's alignment, B; clips of scale 0 do not count.
        windows: Distances k, in frames.
        frames: Numbers of the T decoded frames within their clip.

    Returns:
        The mean over pixels that are valid in both frames of a pair; 0 without any.
    """
    return pair_motion_loss(points, target, scale, window_pairs(frames, windows))
