"""Alignment of a prediction to a target by scale and shift (paper sections 4 and 5).

The solvers minimise sum_i min(trunc, w_i |scale * x_i + shift - y_i|), the truncated weighted L1
error, batched over leading dimensions; trunc None is plain L1. The objective is the smallest of
convex, piecewise linear ones (which samples are truncated), so that it has a minimum where kinks
cross: for a scale and one shift a fit that passes through a sample, which is what is searched.
Nothing here is differentiated through.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyfn_core.geometry.anchor_bounds import AnchorBounds

__all__ = [
    "align_points",
    "align_points_exact",
    "align_points_shift",
    "align_scale",
    "align_scale_shift",
    "truncated_error",
]

SHIFTS = ("none", "z", "xyz")
PROBES = 2  # samples that are tried before the others, to rule these out
_CHUNK = 1 << 15  # terms of the objective that are worked on at a time


@torch.no_grad()
def align_scale(
    x: Tensor, y: Tensor, weight: Tensor, trunc: float | None = None
) -> tuple[Tensor, Tensor]:
    """The scale that minimises sum min(trunc, weight |scale x - y|) over the last dimension; exact.

    x, y, weight: ... x N, weight >= 0. Returns the scale and the error there, both of shape (...).
    Where no sample counts (weight or x zero everywhere) the scale is 0.
    """
    slope = weight * x.abs()
    counts = slope > 0
    centre = torch.where(counts, y / torch.where(counts, x, 1.0), 0.0)
    slope = torch.where(counts, slope, 0.0)
    if trunc is None:
        scale = _weighted_median(centre, slope)
        return scale, (weight * (scale[..., None] * x - y).abs()).sum(-1)
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


def align_scale_shift(
    x: Tensor,
    y: Tensor,
    weight: Tensor,
    trunc: float | None = None,
    anchors: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Scale and shift (each B) of values B x N, e.g. depths or disparities.

    The affine case of align_points, whose other arguments these are.
    """
    scale, shift = align_points(x[..., None], y[..., None], weight, "z", trunc, anchors)
    return scale, shift[..., 0]


@torch.no_grad()
def align_points(
    points: Tensor,
    target: Tensor,
    weight: Tensor,
    shift: str = "z",
    trunc: float | None = None,
    anchors: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Scale (B) and shift (B x D) of B x N x D points against their target, weights B x N.

    shift: "none" (all zero), "z" (of the last axis alone) or "xyz" (of every axis).
    anchors: B x A indices of the samples that the fit may pass through along the shifted axes;
        None tries all of them, but for those that cannot be the best (anchor_bounds).
    Without anchors, "none" and "z" are exact. "xyz" is the best of the fits through one sample
    along all axes at once, as MoGe solves it; align_points_exact knows no such limit.
    Where nothing has weight, scale and shift are 0. Raises ValueError for another shift.
    """
    shifted = _shifted_axes(shift, points)
    batch, _, dims = points.shape
    if shift == "none":
        weights = weight.repeat_interleave(dims, dim=-1)
        scale, _ = align_scale(points.flatten(-2), target.flatten(-2), weights, trunc)
        return scale, points.new_zeros(batch, dims)
    if anchors is None:
        points, target, weight = _weighted_first(points, target, weight)
    problem = _Problem(points, target, weight, shifted, trunc)
    if anchors is None and trunc is not None and weight.shape[1] > PROBES:
        row, anchor = _worth_trying(problem, trunc)
    elif anchors is None:
        row, anchor = torch.nonzero(weight > 0, as_tuple=True)
    else:
        row = torch.arange(batch, device=points.device).repeat_interleave(anchors.shape[1])
        anchor = anchors.flatten()
        row, anchor = (part[weight[row, anchor] > 0] for part in (row, anchor))
    return _best(problem, row, anchor)[:2]


@dataclass(frozen=True)
class _Problem:
    """Points and target B x N x D, weight B x N, the shifted axes, D bool, and trunc."""

    points: Tensor
    target: Tensor
    weight: Tensor
    shifted: Tensor
    trunc: float | None


def _worth_trying(problem: _Problem, trunc: float) -> tuple[Tensor, Tensor]:
    """The entries and anchors that the best fits may pass through.

    The fits through a few samples bound the error of the best one.
    """
    count = (problem.weight > 0).sum(1)
    steps = (torch.arange(PROBES, device=count.device) + 0.5) / PROBES
    spread = (steps * count[:, None]).long()
    rows = torch.arange(len(count), device=count.device).repeat_interleave(PROBES)
    scale, _, _ = _best(problem, *_weighted(problem, rows, spread.flatten()))
    bounds = AnchorBounds(problem.points, problem.target, problem.weight, problem.shifted, trunc)
    near = bounds.errors_at(scale).topk(PROBES, largest=False).indices
    scale, _, error = _best(problem, *_weighted(problem, rows, near.flatten()))
    row, anchor = torch.nonzero(bounds.left(scale, error), as_tuple=True)
    return row, anchor


def _weighted(problem: _Problem, row: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """Those of the anchors that have a weight."""
    counts = problem.weight[row, anchor] > 0
    return row[counts], anchor[counts]


def _best(problem: _Problem, row: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The best of the fits through P samples `anchor` of entries `row`: scale B, shift B x D and
    error B; 0, 0 and infinity in entries without one."""
    batch, count, dims = problem.points.shape
    per_chunk = max(1, _CHUNK // max(1, count * dims))
    errors = problem.points.new_full((batch, count), torch.inf)
    scales = problem.points.new_zeros(batch, count)
    for pair in zip(row.split(per_chunk), anchor.split(per_chunk), strict=True):
        scales[pair], errors[pair] = _through(problem, *pair)
    error, best = errors.min(1)
    rows = torch.arange(batch, device=best.device)
    scale = scales[rows, best]
    shift = problem.target[rows, best] - scale[:, None] * problem.points[rows, best]
    shift = torch.where(torch.isfinite(error)[:, None] & problem.shifted, shift, 0.0)
    return scale, shift, error


def _weighted_first(
    points: Tensor, target: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The samples without those, at the end, that have no weight in any entry of the batch."""
    counts = weight > 0
    most = max(1, int(counts.sum(1).max()))
    order = counts.to(torch.uint8).argsort(dim=1, descending=True, stable=True)[:, :most]
    index = order[..., None].expand(-1, -1, points.shape[-1])
    return points.gather(1, index), target.gather(1, index), weight.gather(1, order)


def _shifted_axes(shift: str, points: Tensor) -> Tensor:
    if shift not in SHIFTS:
        raise ValueError(f"shift {shift!r} is unknown, expected one of {SHIFTS}")
    axes = torch.full((points.shape[-1],), shift == "xyz", device=points.device)
    axes[-1] = shift != "none"
    return axes


def _through(problem: _Problem, row: Tensor, anchor: Tensor) -> tuple[Tensor, Tensor]:
    """The best scale, and its error, of the fit through each of P anchors: P each."""
    x, y = (
        values[row] - (values[row, anchor] * problem.shifted)[:, None]
        for values in (problem.points, problem.target)
    )
    weights = problem.weight[row].repeat_interleave(x.shape[-1], dim=-1)
    return align_scale(x.flatten(1), y.flatten(1), weights, problem.trunc)


def align_points_shift(
    points: Tensor, target: Tensor, weight: Tensor, trunc: float | None = None
) -> Tensor:
    """Shift (B x D) of B x N x D points at scale 1, weights B x N; each axis on its own, exact."""
    apart = (target - points).transpose(-1, -2)
    weights = weight[..., None, :].expand_as(apart)
    return align_scale(torch.ones_like(apart), apart, weights, trunc)[0]


@torch.no_grad()
def align_points_exact(
    points: Tensor, target: Tensor, weight: Tensor, trunc: float | None = None
) -> tuple[Tensor, Tensor]:
    """The best scale (B) and xyz-shift (B x D) of all, of B x N x D points, weights B x N.

    Given the scale, every axis has a best shift of its own, and some optimal scale is the slope
    between two samples along one axis. Without truncation the error is convex in the scale: the
    D N (N - 1) / 2 slopes are searched by bisection. With it they are all tried, N^3 log N:
    meant for dozens of samples.
    """
    start = align_points(points, target, weight, "xyz", trunc)[0]
    first, second = torch.triu_indices(points.shape[1], points.shape[1], 1, device=points.device)
    run = (points[:, first] - points[:, second]).flatten(1)
    rise = (target[:, first] - target[:, second]).flatten(1)
    counts = ((weight[:, first] > 0) & (weight[:, second] > 0)).repeat_interleave(
        points.shape[-1], dim=-1
    )
    steep = counts & (run != 0)
    slopes = torch.where(steep, rise / torch.where(steep, run, 1.0), start[:, None])
    slopes = torch.cat([start[:, None], slopes], dim=1)
    if trunc is None:
        scale = _bisect(points, target, weight, slopes.sort(dim=1).values)
    else:
        per_chunk = max(1, _CHUNK // max(1, points.numel()))
        errors = [
            _error_of_scale(points, target, weight, trunc, chunk)
            for chunk in slopes.split(per_chunk, 1)
        ]
        scale = slopes.gather(1, torch.cat(errors, 1).argmin(1, keepdim=True))[:, 0]
    return scale, align_points_shift(scale[:, None, None] * points, target, weight, trunc)


def _error_of_scale(
    points: Tensor, target: Tensor, weight: Tensor, trunc: float | None, scales: Tensor
) -> Tensor:
    """scales B x S -> the error with the best shifts, B x S."""
    apart = target[:, None] - scales[..., None, None] * points[:, None]
    apart = apart.transpose(-1, -2)
    weights = weight[:, None, None].expand_as(apart)
    return align_scale(torch.ones_like(apart), apart, weights, trunc)[1].sum(-1)


def _bisect(points: Tensor, target: Tensor, weight: Tensor, slopes: Tensor) -> Tensor:
    """The best of sorted slopes B x S where the error is convex in them: B."""
    low = torch.zeros(len(slopes), 1, dtype=torch.long, device=slopes.device)
    high = torch.full_like(low, slopes.shape[1] - 1)
    while bool((low < high).any()):
        middle = (low + high) // 2
        here = slopes.gather(1, middle)
        # The next larger slope: equal ones say nothing about the direction.
        after = torch.searchsorted(slopes, here, right=True).clamp(max=slopes.shape[1] - 1)
        pair = torch.cat([here, slopes.gather(1, after)], dim=1)
        error = _error_of_scale(points, target, weight, None, pair)
        falls = error[:, 1:] < error[:, :1]
        low, high = torch.where(falls, after, low), torch.where(falls, high, middle)
    return slopes.gather(1, low)[:, 0]


def truncated_error(
    points: Tensor,
    target: Tensor,
    weight: Tensor,
    scale: Tensor,
    shift: Tensor,
    trunc: float | None = None,
) -> Tensor:
    """What the solvers minimise, per batch entry: B x N x D points, scale B, shift B x D -> B."""
    aligned = scale[:, None, None] * points + shift[:, None]
    error = weight[..., None] * (aligned - target).abs()
    return (error if trunc is None else error.clamp(max=trunc)).sum((1, 2))
