"""L_mask: where geometry is finite (paper section 4)."""

from __future__ import annotations

from torch import Tensor

from dyfn_core.losses.target import Target


def mask_loss(mask: Tensor, target: Target) -> Tensor:
    """L_mask = mean_i (m_i - m*_i)^2, m* 1 on valid and 0 on infinite pixels (paper section 4).

    The mean is MoGe's: over all pixels, those that are neither valid nor infinite being 0.

    Args:
        mask: Raw mask output, B x H x W.
        target: The true geometry of the frames.

    Returns:
        The loss of each frame, B.
    """
    counted = target.valid | target.infinite
    return ((mask - target.valid.float()).square() * counted).mean((-2, -1))
