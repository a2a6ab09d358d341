"""The scale and shift of L_align, exact (paper section 4)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.losses.clip_alignment import check_mode
from dyfn_core.losses.full.whole_frame import align_samples
from dyfn_core.losses.resample import nearest_valid, pick
from dyfn_core.losses.target import ClipTarget


def align_clips(
    points: Tensor, target: ClipTarget, mode: str, resolution: int = 32, trunc: float = 1.0
) -> tuple[Tensor, Tensor]:
    """argmin_(s, t) sum_i min(trunc, (1 / z*_i) |s p_i + t - p*_i|_1), t along z (paper section 4).

    Every frame is sampled on a resolution x resolution grid, mask-aware. All samples are anchors,
    in float64, detached. With mode "all" the cost grows with the square of the number of frames;
    the released code takes a resolution of 8 there.

    Args:
        points: Predicted points, B x T x H x W x 3.
        target: The true geometry of the clips.
        mode: "first" fits to the first frame alone, "all" to every frame.
        resolution: Side of the grid of samples of one frame.
        trunc: Weighted errors beyond this count as this.

    Returns:
        Scale, B, and shift, B x 3; scale 0 where nothing can be aligned.

    Raises:
        ValueError: For another mode.
    """
    check_mode(mode)
    frames = 1 if mode == "first" else target.length
    valid = target.valid[:, :frames]
    index, seen = nearest_valid(valid.flatten(0, 1), (resolution, resolution))

    def sample(values: Tensor) -> Tensor:
        chosen = pick(values[:, :frames].flatten(0, 1), index)
        return torch.unflatten(chosen, 0, (-1, frames)).flatten(1, 2)

    seen = torch.unflatten(seen, 0, (-1, frames)).flatten(1)
    return align_samples(sample(points.detach()), sample(target.points), seen, trunc, points.dtype)
