"""Alignment of a prediction to a target by scale and shift (paper sections 4 and 5).

The solvers minimise sum_i min(trunc, w_i |scale * x_i + shift - y_i|), the truncated weighted L1
error, batched over leading dimensions; trunc None is plain L1. Scale alone is solved exactly.
With a shift, the fit is assumed to pass exactly through one sample (the anchor), as an optimal
one does per shifted axis: every candidate anchor's best scale is found exactly, the best anchor
wins. Nothing here is differentiated through.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyfn_core.geometry.l1_fit import fit_scale_shift

__all__ = [
    "align_points_scale",
    "align_points_scale_xyz_shift",
    "align_points_scale_z_shift",
    "align_points_shift",
    "align_scale",
    "align_scale_shift",
    "fit_scale_shift",
]


@torch.no_grad()
def align_scale(
    x: Tensor, y: Tensor, weight: Tensor, trunc: float | None = None
) -> tuple[Tensor, Tensor]:
    """The scale that minimises sum min(trunc, weight |scale x - y|) over the last dimension.

    x, y, weight: ... x N, weight >= 0. Returns the scale and the error there, both of shape (...).
    Where no sample counts (weight or x zero everywhere) the scale is 0.
    """
    slope = weight * x.abs()
    counts = slope > 0
    centre = torch.where(counts, y / torch.where(counts, x, 1.0), 0.0)
    slope = torch.where(counts, slope, 0.0)
    if trunc is None:
        return _weighted_median(centre, slope), _error_at_median(x, y, weight, centre, slope)
    reach = torch.where(counts, trunc / torch.where(counts, slope, 1.0), 0.0)
    # Each term is flat, falls to the centre, rises, is flat again: sort where slopes change.
    place = torch.cat([centre - reach, centre, centre + reach], dim=-1)
    change = torch.cat([-slope, 2 * slope, -slope], dim=-1)
    place, order = place.sort(dim=-1)
    change = change.gather(-1, order)
    slopes = change.cumsum(-1)
    rises = (slopes[..., :-1] * place.diff(dim=-1)).cumsum(-1)
    descent = torch.cat([torch.zeros_like(rises[..., :1]), rises], dim=-1)
    descent = torch.where(change > 0, descent, torch.inf)
    index = descent.argmin(dim=-1)
    scale = place.gather(-1, index[..., None])[..., 0]
    scale = torch.where(counts.any(-1), scale, 0.0)
    error = (weight * (scale[..., None] * x - y).abs()).clamp(max=trunc).sum(-1)
    return scale, error


def _weighted_median(values: Tensor, weight: Tensor) -> Tensor:
    values, order = values.sort(dim=-1)
    cumulative = weight.gather(-1, order).cumsum(-1)
    half = 0.5 * cumulative[..., -1:]
    index = torch.searchsorted(cumulative, half).clamp(max=values.shape[-1] - 1)
    return values.gather(-1, index)[..., 0]


def _error_at_median(x: Tensor, y: Tensor, weight: Tensor, centre: Tensor, slope: Tensor) -> Tensor:
    scale = _weighted_median(centre, slope)
    return (weight * (scale[..., None] * x - y).abs()).sum(-1)


@torch.no_grad()
def align_scale_shift(
    x: Tensor,
    y: Tensor,
    weight: Tensor,
    trunc: float | None = None,
    anchors: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Scale and shift of values, e.g. depths.

    x, y, weight: B x N. anchors: B x A indices of the candidate anchors; None tries all of them
    (exact, and quadratic in N). Returns scale and shift, each B.
    """
    points_x, points_y = x[..., None], y[..., None]
    shifted = torch.ones(1, dtype=torch.bool, device=x.device)
    scale, shift = _align_anchored(points_x, points_y, weight, trunc, anchors, shifted)
    return scale, shift[..., 0]


def align_points_scale(
    points: Tensor, target: Tensor, weight: Tensor, trunc: float | None = None
) -> Tensor:
    """The scale of B x N x 3 points against their target, weights B x N. Returns B."""
    x, y = points.flatten(-2), target.flatten(-2)
    return align_scale(x, y, weight.repeat_interleave(points.shape[-1], dim=-1), trunc)[0]


def align_points_scale_z_shift(
    points: Tensor,
    target: Tensor,
    weight: Tensor,
    trunc: float | None = None,
    anchors: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Scale (B) and shift (B x 3, only z differs from 0) of B x N x 3 points, weights B x N."""
    shifted = torch.tensor([False, False, True], device=points.device)
    return _align_anchored(points, target, weight, trunc, anchors, shifted)


def align_points_scale_xyz_shift(
    points: Tensor,
    target: Tensor,
    weight: Tensor,
    trunc: float | None = None,
    anchors: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Scale (B) and shift (B x 3) of B x N x 3 points, weights B x N."""
    shifted = torch.tensor([True, True, True], device=points.device)
    return _align_anchored(points, target, weight, trunc, anchors, shifted)


def align_points_shift(
    points: Tensor, target: Tensor, weight: Tensor, trunc: float | None = None
) -> Tensor:
    """Shift (B x D) of B x N x D points at scale 1, weights B x N; each axis on its own, exact."""
    apart = (target - points).transpose(-1, -2)
    weights = weight[..., None, :].expand_as(apart)
    return align_scale(torch.ones_like(apart), apart, weights, trunc)[0]


@torch.no_grad()
def _align_anchored(
    points: Tensor,
    target: Tensor,
    weight: Tensor,
    trunc: float | None,
    anchors: Tensor | None,
    shifted: Tensor,
) -> tuple[Tensor, Tensor]:
    """B x N x D points: the best fit through one of the anchors along the shifted axes."""
    batch, count, dims = points.shape
    if anchors is None:
        anchors = torch.arange(count, device=points.device).expand(batch, -1)
    index = anchors[..., None].expand(-1, -1, dims)
    from_points = points.gather(1, index) * shifted
    from_target = target.gather(1, index) * shifted
    x = (points[:, None] - from_points[:, :, None]).flatten(-2)
    y = (target[:, None] - from_target[:, :, None]).flatten(-2)
    weights = weight.repeat_interleave(dims, dim=-1)[:, None].expand_as(x)
    scales, errors = align_scale(x, y, weights, trunc)
    usable = weight.gather(1, anchors) > 0
    best = torch.where(usable, errors, torch.inf).argmin(dim=1)
    rows = torch.arange(batch, device=points.device)
    scale = torch.where(usable.any(1), scales[rows, best], 0.0)
    shift = from_target[rows, best] - scale[:, None] * from_points[rows, best]
    return scale, torch.where(usable.any(1)[:, None], shift, 0.0)
