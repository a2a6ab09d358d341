"""L_ssi: MiDaS' scale-and-shift-invariant error of single frames of disparity (paper section 4)."""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.losses.target import Target

FEWEST = 16  # frames with fewer valid pixels count for nothing
SCALES = 4
GRADIENT_WEIGHT = 0.5
TRIM = 0.2


def ssi_loss(disparity: Tensor, target: Target, trim: float = TRIM) -> Tensor:
    """L_ssi = sum'_i |r_i| / 2N + 0.5 sum_k mean |grad r^k| (MiDaS, eq. 7 and 11; paper section 4).

    r is the difference of disparity and 1 / z*, both centred on their median and divided by their
    mean absolute deviation over the frame's N valid pixels. The sum leaves out the largest `trim`
    of the residuals; r^k takes every 2^k-th row and column.

    Args:
        disparity: Predicted disparity up to scale and shift, B x H x W.
        target: The true geometry of the frames.
        trim: Share of the residuals that is left out.

    Returns:
        The mean over frames with FEWEST valid pixels and some variation in the truth; 0 without
        any.
    """
    valid = target.valid
    truth = torch.where(valid, 1 / torch.where(valid, target.points[..., 2], 1.0), 0.0)
    ours, _ = _normalised(disparity, valid)
    theirs, spread = _normalised(truth, valid)
    usable = (valid.sum((1, 2)) >= FEWEST) & (spread > 1e-9)
    residual = torch.where(valid & usable[:, None, None], ours - theirs, 0.0)
    loss = _trimmed(residual.abs(), valid, trim)
    for scale in range(SCALES):
        step = 2**scale
        loss = loss + GRADIENT_WEIGHT * _roughness(
            residual[:, ::step, ::step], valid[:, ::step, ::step]
        )
    return torch.where(usable, loss, 0.0).sum() / usable.sum().clamp(min=1)


def _normalised(values: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """B x H x W with median 0 and mean absolute deviation 1 on the valid pixels; the deviation."""
    flat, counts = values.flatten(1), valid.flatten(1)
    median = torch.where(counts, flat, torch.inf).sort(dim=1).values
    middle = ((counts.sum(1) - 1) // 2).clamp(min=0)
    median = median.gather(1, middle[:, None])
    median = torch.where(counts.any(1, keepdim=True), median, 0.0)
    centred = torch.where(counts, flat - median, 0.0)
    spread = centred.abs().sum(1) / counts.sum(1).clamp(min=1)
    return (centred / spread.clamp(min=1e-9)[:, None]).view_as(values), spread


def _trimmed(error: Tensor, valid: Tensor, trim: float) -> Tensor:
    """B: half the sum of the smaller errors over the number of all, as MiDaS averages it."""
    count = valid.flatten(1).sum(1)
    ordered = torch.where(valid, error, torch.inf).flatten(1).sort(dim=1).values
    place = torch.arange(ordered.shape[1], device=error.device)
    kept = place < (count * (1 - trim)).floor()[:, None]
    return torch.where(kept, ordered, 0.0).sum(1) / (2 * count.clamp(min=1))


def _roughness(residual: Tensor, valid: Tensor) -> Tensor:
    """B: the mean absolute change of the residual between valid neighbours."""
    total = residual.new_zeros(len(residual))
    for axis in (1, 2):
        length = residual.shape[axis] - 1
        both = valid.narrow(axis, 0, length) & valid.narrow(axis, 1, length)
        total = total + (residual.diff(dim=axis).abs() * both).sum((1, 2))
    return total / valid.sum((1, 2)).clamp(min=1)
