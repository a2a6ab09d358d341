"""Anchors are left out of an alignment only where they cannot be the best."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dyfn_core.geometry.alignment import align_points, truncated_error
from dyfn_core.geometry.anchor_bounds import AnchorBounds
from tests.support.every_anchor import align_through_every_sample
from tests.support.seeded import normal, uniform


def relation(
    seed: int, entries: int, count: int, scale: float, noise: float, outliers: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Points, target and weights; every `outliers`-th sample is far off, some have no weight."""
    points = normal(seed, entries, count, 3, dtype=torch.float64)
    target = scale * points + normal(seed + 1, entries, 1, 3, dtype=torch.float64)
    target = target + noise * normal(seed + 2, entries, count, 3, dtype=torch.float64)
    target[:, ::outliers] += 3 * normal(seed + 3, entries, 1, 3, dtype=torch.float64)
    weight = uniform(seed + 4, entries, count, dtype=torch.float64)
    return points, target, torch.where(weight < 0.1, 0.0, weight)


@pytest.mark.parametrize("shift", ["z", "xyz"])
@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(3, 40),
    scale=st.sampled_from([1.5, 0.01, 40.0, -2.0, 0.0]),
    noise=st.sampled_from([0.0, 0.02, 0.3, 3.0]),
    outliers=st.integers(2, 9),
    rounded=st.booleans(),
)
def test_the_fit_is_that_through_every_sample(
    seed: int, count: int, scale: float, noise: float, outliers: int, rounded: bool, shift: str
) -> None:
    points, target, weight = relation(seed, 3, count, scale, noise, outliers)
    if rounded:
        points, target = (points * 4).round() / 4, (target * 4).round() / 4
    found = align_points(points, target, weight, shift, 1.0)
    wanted = align_through_every_sample(points, target, weight, shift, 1.0)
    ours, best = (truncated_error(points, target, weight, *fit, 1.0) for fit in (found, wanted))
    torch.testing.assert_close(ours, best, rtol=1e-9, atol=1e-9)
    if noise and not rounded:  # without ties
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("shift", ["z", "xyz"])
def test_most_samples_are_ruled_out(shift: str) -> None:
    points, target, weight = relation(7, 4, 200, 1.5, 0.1, 5)
    if shift == "z":
        target[..., :2] = 1.5 * points[..., :2] + 0.1 * normal(9, 4, 200, 2, dtype=torch.float64)
    scale, shifts = align_points(points, target, weight, shift, 1.0)
    error = truncated_error(points, target, weight, scale, shifts, 1.0)
    shifted = torch.tensor([shift == "xyz", shift == "xyz", True])
    left = AnchorBounds(points, target, weight, shifted, 1.0).left(scale, error)
    assert not (left & (weight == 0)).any()
    assert float(left.sum() / (weight > 0).sum()) < 0.3


def test_nothing_is_ruled_out_by_a_worse_error_than_any() -> None:
    points, target, weight = relation(7, 2, 30, 1.5, 0.1, 5)
    bounds = AnchorBounds(points, target, weight, torch.ones(3, dtype=torch.bool), 1.0)
    left = bounds.left(torch.ones(2), torch.full((2,), 1e4))
    assert torch.equal(left, weight > 0)
