"""Where geometry is finite: the squared error of the raw mask (paper section 4)."""

from __future__ import annotations

from torch import Tensor

from dyfn_core.losses.target import Target


def mask_loss(mask: Tensor, target: Target) -> Tensor:
    """Mean (mask - wanted)^2, wanted 1 on valid and 0 on infinite pixels; others do not count.

    mask: B x H x W raw mask output.
    """
    counted = target.valid | target.infinite
    error = (mask - target.valid.float()).square()
    return (error * counted).sum() / counted.sum().clamp(min=1)


def mask_pixel_loss(mask: Tensor, target: Target) -> Tensor:
    """The same error as MoGe averages it: B, over all pixels, uncounted ones being 0."""
    counted = target.valid | target.infinite
    return ((mask - target.valid.float()).square() * counted).mean((-2, -1))
