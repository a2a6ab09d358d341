"""The batched solvers against mixed-integer programming, whose bound is a proof."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import Bounds, LinearConstraint, milp
from torch import Tensor

from dyfn_core.geometry.alignment import (
    align_points,
    align_points_exact,
    align_points_shift,
    align_scale_shift,
    truncated_error,
)
from tests.support.seeded import normal, uniform

FAR = 200.0  # larger than any weighted residual here
TRUNCS = st.sampled_from([None, 1.0, 0.2])


def least_error(
    x: np.ndarray, y: np.ndarray, w: np.ndarray, shifted: list[bool], trunc: float | None
) -> float:
    """min over s and t of sum min(trunc, w |s x + t - y|), x and y N x D, by HiGHS.

    Variables: s, one t per shifted axis, per term its error and (truncated) a binary that gives
    the sample up for the price of trunc.
    """
    count, dims = x.shape
    terms, head = count * dims, 1 + sum(shifted)
    columns = head + terms * (1 if trunc is None else 2)
    column_of_shift = {axis: 1 + i for i, axis in enumerate(np.flatnonzero(shifted).tolist())}
    rows, lower = [], []
    for i in range(count):
        for axis in range(dims):
            term = head + i * dims + axis
            for sign in (1.0, -1.0):
                row = np.zeros(columns)
                row[0] = -sign * w[i] * x[i, axis]
                if axis in column_of_shift:
                    row[column_of_shift[axis]] = -sign * w[i]
                row[term] = 1
                if trunc is not None:
                    row[term + terms] = FAR
                rows.append(row)
                lower.append(-sign * w[i] * y[i, axis])
    cost = np.zeros(columns)
    cost[head : head + terms] = 1
    low = np.full(columns, -np.inf)
    high = np.full(columns, np.inf)
    low[head:] = 0
    integrality = np.zeros(columns)
    if trunc is not None:
        cost[head + terms :] = trunc
        high[head + terms :] = 1
        integrality[head + terms :] = 1
        low[:head], high[:head] = -50, 50
    found = milp(
        cost,
        constraints=LinearConstraint(np.array(rows), np.array(lower), np.inf),
        bounds=Bounds(low, high),
        integrality=integrality,
        options={"mip_rel_gap": 0.0},
    )
    assert found.success, found.message
    return float(found.fun)


def draw(seed: int, count: int, dims: int, rounded: bool) -> tuple[Tensor, Tensor, Tensor]:
    """A noisy affine relation with outliers and some zero weights; rounding makes ties."""
    rng = np.random.default_rng(seed)
    x = normal(rng, 1, count, dims, dtype=torch.float64)
    y = 1.5 * x + normal(rng, 1, 1, dims, dtype=torch.float64)
    y = y + 0.3 * normal(rng, 1, count, dims, dtype=torch.float64)
    y[:, ::3] += 2 * normal(rng, 1, len(range(0, count, 3)), dims, dtype=torch.float64)
    w = uniform(rng, 1, count, dtype=torch.float64)
    w = torch.where(w < 0.15, 0.0, w)
    w[:, 0] = 0.7
    if rounded:
        x, y = (x * 4).round() / 4, (y * 4).round() / 4
    return x, y, w


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), trunc=TRUNCS, rounded=st.booleans())
def test_scale_and_z_shift_are_optimal(seed: int, trunc: float | None, rounded: bool) -> None:
    x, y, w = draw(seed, 4, 3, rounded)
    ours = truncated_error(x, y, w, *align_points(x, y, w, "z", trunc), trunc)
    best = least_error(x[0].numpy(), y[0].numpy(), w[0].numpy(), [False, False, True], trunc)
    assert float(ours) == pytest.approx(best, rel=1e-6, abs=1e-6)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), trunc=TRUNCS, rounded=st.booleans())
def test_scale_alone_is_optimal(seed: int, trunc: float | None, rounded: bool) -> None:
    x, y, w = draw(seed, 4, 3, rounded)
    scale, shift = align_points(x, y, w, "none", trunc)
    assert not shift.any()
    best = least_error(x[0].numpy(), y[0].numpy(), w[0].numpy(), [False] * 3, trunc)
    found = float(truncated_error(x, y, w, scale, shift, trunc))
    assert found == pytest.approx(best, rel=1e-6, abs=1e-6)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), trunc=TRUNCS, rounded=st.booleans())
def test_affine_fit_is_optimal(seed: int, trunc: float | None, rounded: bool) -> None:
    x, y, w = draw(seed, 8, 1, rounded)
    scale, shift = align_scale_shift(x[..., 0], y[..., 0], w, trunc)
    best = least_error(x[0].numpy(), y[0].numpy(), w[0].numpy(), [True], trunc)
    found = float(truncated_error(x, y, w, scale, shift[:, None], trunc))
    assert found == pytest.approx(best, rel=1e-6, abs=1e-6)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), trunc=TRUNCS, rounded=st.booleans())
def test_exact_scale_and_xyz_shift_are_optimal(
    seed: int, trunc: float | None, rounded: bool
) -> None:
    x, y, w = draw(seed, 4, 3, rounded)
    best = least_error(x[0].numpy(), y[0].numpy(), w[0].numpy(), [True] * 3, trunc)
    exact = float(truncated_error(x, y, w, *align_points_exact(x, y, w, trunc), trunc))
    one_sample = float(truncated_error(x, y, w, *align_points(x, y, w, "xyz", trunc), trunc))
    assert exact == pytest.approx(best, rel=1e-6, abs=1e-6)
    assert one_sample >= exact - 1e-9


@settings(max_examples=12, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), trunc=TRUNCS)
def test_xyz_shift_is_the_best_through_one_sample(seed: int, trunc: float | None) -> None:
    """Exhaustive: through each sample, every scale at which some coordinate is met exactly."""
    x, y, w = draw(seed, 6, 3, False)
    errors = []
    for anchor in torch.nonzero(w[0] > 0)[:, 0].tolist():
        slopes = ((y - y[:, [anchor]]) / (x - x[:, [anchor]]))[0].flatten()
        for slope in slopes[torch.isfinite(slopes)][:, None]:
            shift = y[:, anchor] - slope * x[:, anchor]
            errors.append(float(truncated_error(x, y, w, slope, shift, trunc)))
    found = float(truncated_error(x, y, w, *align_points(x, y, w, "xyz", trunc), trunc))
    assert found == pytest.approx(min(errors), rel=1e-9)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), trunc=TRUNCS)
def test_shift_alone_is_optimal_for_its_axis(seed: int, trunc: float | None) -> None:
    x, y, w = draw(seed, 9, 1, False)
    shift = align_points_shift(x, y, w, trunc)
    one = torch.ones(1, dtype=torch.float64)
    found = float(truncated_error(x, y, w, one, shift, trunc))
    tried = [
        float(truncated_error(x, y, w, one, candidate[None], trunc)) for candidate in (y - x)[0]
    ]
    assert found == pytest.approx(min(tried), rel=1e-9)


@pytest.mark.parametrize("trunc", [None, 1.0])
def test_a_batch_is_solved_like_its_parts(trunc: float | None) -> None:
    parts = [draw(seed, 12, 3, seed % 2 == 0) for seed in range(5)]
    x, y, w = (torch.cat(column) for column in zip(*parts, strict=True))
    w[3] = 0
    for solve in (
        partial(align_points, shift="z", trunc=trunc),
        partial(align_points, shift="xyz", trunc=trunc),
        partial(align_points_exact, trunc=trunc),
    ):
        scale, shift = solve(x, y, w)
        for i in range(5):
            alone = solve(x[i : i + 1], y[i : i + 1], w[i : i + 1])
            torch.testing.assert_close(scale[i], alone[0][0])
            torch.testing.assert_close(shift[i], alone[1][0])
        assert float(scale[3]) == 0
        assert not shift[3].any()


def test_many_samples_are_worked_on_in_parts_with_the_same_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    x, y, w = draw(0, 40, 3, False)
    whole = align_points(x, y, w, "z", 1.0)
    exact = align_points_exact(x, y, w, 1.0)
    monkeypatch.setattr("dyfn_core.geometry.alignment._CHUNK", 500)
    for ours, theirs in zip(
        (*whole, *exact),
        (*align_points(x, y, w, "z", 1.0), *align_points_exact(x, y, w, 1.0)),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs)


def test_unknown_shift_is_refused() -> None:
    with pytest.raises(ValueError, match="'xy'"):
        align_points(*draw(0, 4, 3, False), "xy")
