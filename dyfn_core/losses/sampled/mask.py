"""L_mask, averaged over what is known."""

from __future__ import annotations

from torch import Tensor

from dyfn_core.losses.target import Target


def mask_loss(mask: Tensor, target: Target) -> Tensor:
    """L_mask = mean_i (m_i - m*_i)^2, m* 1 on valid and 0 on infinite pixels (paper section 4).

    The mean is over the pixels that are valid or infinite, so sparse truth weighs like dense truth.

    Args:
        mask: Raw mask output, B x H x W.
        target: The true geometry of the frames.

    Returns:
        The mean over the batch; 0 without a valid or infinite pixel.
    """
    counted = target.valid | target.infinite
    error = (mask - target.valid.float()).square()
    return (error * counted).sum() / counted.sum().clamp(min=1)
