"""Which anchors an alignment need not try: lower bounds of the error of the fits through each.

With a scale s, the fit through sample k leaves c_i - c_k at sample i, where c = y - s x. The error
of that fit, sum_i min(trunc, w_i |c_i - c_k|), changes by at most sum_i w_i |x_i - x_k| per unit of
scale. Where it exceeds the error of a fit that is known, a whole interval of scales is ruled out;
an anchor whose every scale is ruled out need not be solved. Bounds are in float32, with the
rounding on the safe side.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

_TERMS = 1 << 18  # worked on at a time, so that they stay in the processor's cache
_ROUNDS = 4  # of ruling out, before what is left is gathered
_WORTHWHILE = 0.98  # more left than this share of those before: the rest is solved
_RANGE = 3.0  # times a good scale: what is beyond is ruled out at once
_ROUNDING = 2.0**-20  # of one term, relative to what is subtracted in it


class AnchorBounds:
    """Bounds of the errors of all fits through each sample of B entries.

    Args:
        points: B x N x D.
        target: B x N x D.
        weight: B x N, not negative.
        shifted: Along which axes the fits are shifted, D bool.
        trunc: Weighted errors beyond this count as this.
    """

    def __init__(
        self, points: Tensor, target: Tensor, weight: Tensor, shifted: Tensor, trunc: float
    ) -> None:
        share = weight / weight.sum(1, keepdim=True).clamp(min=1e-30)
        x, y = (
            v[..., shifted] - (share[..., None] * v[..., shifted]).sum(1, keepdim=True)
            for v in (points, target)
        )
        fixed_x, fixed_y = (v[..., ~shifted].flatten(1) for v in (points, target))
        weights = weight.repeat_interleave(int((~shifted).sum()), 1)
        self._fixed = _Curve.of(fixed_x, fixed_y, weights, trunc)
        self._x, self._y, self._weight = x.float(), y.float(), weight.float()
        self._trunc = trunc

    def errors_at(self, scale: Tensor) -> Tensor:
        """Find the errors, along the shifted axes, of the fits through every sample with one scale.

        Args:
            scale: Of each entry, B.

        Returns:
            B x N; infinite for samples without weight.
        """
        rest = self._y - scale[:, None, None].float() * self._x
        found = []
        per_chunk = max(1, _TERMS // max(1, rest[0].numel() * rest.shape[1]))
        for part, weight in zip(rest.split(per_chunk), self._weight.split(per_chunk), strict=True):
            apart = (part[:, None] - part[:, :, None]).abs_().mul_(weight[:, None, :, None])
            found.append(apart.clamp_(max=self._trunc).sum((2, 3)))
        return torch.where(self._weight > 0, torch.cat(found), torch.inf)

    def left(self, scale: Tensor, error: Tensor) -> Tensor:
        """Find the samples that the best fit may pass through.

        Args:
            scale: A scale of a good fit of each entry, B.
            error: The error of that fit, B.

        Returns:
            B x N bool; False only where no fit through the sample has an error of `error` or less.
        """
        edge = (scale * _RANGE).float().clamp(min=0)
        reach = self._y.abs().amax((1, 2)) + edge * self._x.abs().amax((1, 2))
        rounding = _ROUNDING * reach * self._weight.sum(1) * self._x.shape[2]
        limit = (error * (1 + 1e-4)).float() + rounding
        left = self._weight > 0
        pairs_at_a_time = max(1, _TERMS // max(1, self._x[0].numel()))
        for pairs in torch.nonzero(left).split(pairs_at_a_time):
            row, anchor = pairs.unbind(1)
            left[row, anchor] = self._fits(row, anchor, limit).possible(edge[row])
        return left

    def _fits(self, row: Tensor, anchor: Tensor, limit: Tensor) -> _Fits:
        weight = self._weight[row][..., None]
        x, y = (
            ((v[row] - v[row, anchor][:, None]) * weight).flatten(1) for v in (self._x, self._y)
        )
        slope = x.abs().sum(1) + self._fixed.slope.sum(1)[row].to(x)
        return _Fits(x, y, row, slope, limit[row], self._fixed, self._trunc)


@dataclass(frozen=True)
class _Fits:
    """The fits through P samples.

    x, y: P x T from the sample, times the weights, along the shifted axes. row: the entry of each.
    slope: how fast the error may change. limit: the error that it must not exceed. fixed: the
    errors along the other axes.
    """

    x: Tensor
    y: Tensor
    row: Tensor
    slope: Tensor
    limit: Tensor
    fixed: _Curve
    trunc: float

    def possible(self, edge: Tensor) -> Tensor:
        """Whether some scale is not ruled out: P bool. edge: of what is ruled out at once, P."""
        possible = self._outside(edge) <= self.limit
        place = torch.nonzero(~possible)[:, 0]
        fits, low, high = self._at(place), torch.zeros_like(edge)[place], edge[place]
        while len(place):
            for _ in range(_ROUNDS):
                low, high = low + fits._ruled_out(low), high - fits._ruled_out(high)
            kept = torch.nonzero(low <= high)[:, 0]
            worthwhile = len(kept) < _WORTHWHILE * len(place)
            fits, place, low, high = fits._at(kept), place[kept], low[kept], high[kept]
            if not worthwhile:
                break
        possible[place] = True
        return possible

    def _outside(self, edge: Tensor) -> Tensor:
        """A bound of the error of every scale s < 0 or s > edge: P.

        Above, |s x - y| is at least edge |x| - |y|; below, at least |y| where x and y have one
        sign.
        """
        above = (self.x.abs() * edge[:, None] - self.y.abs()).clamp_(0, self.trunc)
        below = self.y.abs().mul_(self.x * self.y >= 0).clamp_(max=self.trunc)
        fixed_above, fixed_below = self.fixed.outside(self.row, edge)
        return torch.minimum(above.sum(1) + fixed_above, below.sum(1) + fixed_below)

    def _ruled_out(self, scale: Tensor) -> Tensor:
        """How far around a scale (P) the error stays above the limit: P."""
        rest = torch.addcmul(self.y, self.x, scale[:, None], value=-1)
        error = rest.abs_().clamp_(max=self.trunc).sum(1) + self.fixed.at(self.row, scale)
        return (error - self.limit).clamp_(min=0) / self.slope.clamp(min=1e-30)

    def _at(self, place: Tensor) -> _Fits:
        x, y, row, slope, limit = (
            v[place] for v in (self.x, self.y, self.row, self.slope, self.limit)
        )
        return _Fits(x, y, row, slope, limit, self.fixed, self.trunc)


@dataclass(frozen=True)
class _Curve:
    """sum_i min(trunc, slope_i |s - centre_i|) as a function of s: B x M terms, float64.

    places: where its slope changes, sorted, B x 3 M. slopes, offsets: of the lines before the
    first and after each of them.
    """

    centre: Tensor
    slope: Tensor
    trunc: float
    places: Tensor
    slopes: Tensor
    offsets: Tensor

    @staticmethod
    def of(x: Tensor, y: Tensor, weight: Tensor, trunc: float) -> _Curve:
        """Of the terms min(trunc, weight |s x - y|), B x M; those of x = 0 are left out."""
        slope = weight * x.abs()
        counts = slope > 0
        centre = torch.where(counts, y / torch.where(counts, x, 1.0), 0.0)
        reach = torch.where(counts, trunc / torch.where(counts, slope, 1.0), 0.0)
        places, order = torch.cat([centre - reach, centre, centre + reach], 1).sort(1)
        change = torch.cat([-slope, 2 * slope, -slope], 1).gather(1, order)
        start = trunc * counts.sum(1, keepdim=True).to(slope)
        slopes = torch.cat([torch.zeros_like(start), change.cumsum(1)], 1)
        offsets = torch.cat([start, start - (change * places).cumsum(1)], 1)
        return _Curve(centre, slope, trunc, places, slopes, offsets)

    def at(self, row: Tensor, scale: Tensor) -> Tensor:
        """Its values in entries `row` (P, rising) at scales P."""
        if not self.places.shape[1]:
            return torch.zeros_like(scale)
        rows, counts = row.unique_consecutive(return_counts=True)
        found = []
        for entry, part in zip(rows.tolist(), scale.double().split(counts.tolist()), strict=True):
            index = torch.searchsorted(self.places[entry], part.to(self.places))
            found.append(self.slopes[entry, index] * part + self.offsets[entry, index])
        return torch.cat(found).to(scale) if found else torch.zeros_like(scale)

    def outside(self, row: Tensor, edge: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds of its values in entries `row` at scales above `edge`, and at those below 0."""
        rows, place = row.unique_consecutive(return_inverse=True)
        first = torch.searchsorted(place, torch.arange(len(rows), device=row.device))
        reach = edge[first, None] - self.centre[rows].abs()
        above = (self.slope[rows] * reach).clamp(0, self.trunc).sum(1)
        below = (self.slope[rows] * self.centre[rows]).clamp(0, self.trunc).sum(1)
        return above[place].to(edge), below[place].to(edge)
