"""The alignment solvers: optimal against independent solvers, equal to the golden ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from torch import Tensor

from dyfn_core.geometry.alignment import (
    align_points,
    align_points_shift,
    align_scale,
    align_scale_shift,
)
from dyfn_core.geometry.l1_fit import fit_scale_shift
from tests.support.seeded import normal, uniform

TRUNCS = (None, 1.0, 0.2)


def linear_program(x: np.ndarray, y: np.ndarray, w: np.ndarray) -> tuple[float, float]:
    """min sum w |s x + t - y| as a linear program over s, t and one bound a sample."""
    count = len(x)
    bounds = -np.eye(count)
    above = np.hstack([x[:, None], np.ones((count, 1)), bounds])
    below = np.hstack([-x[:, None], -np.ones((count, 1)), bounds])
    result = linprog(
        np.concatenate([[0, 0], w]),
        A_ub=np.vstack([above, below]),
        b_ub=np.concatenate([y, -y]),
        bounds=[(None, None)] * 2 + [(0, None)] * count,
    )
    return result.x[0], result.x[1]


def l1(s: float, t: float, x: np.ndarray, y: np.ndarray, w: np.ndarray) -> float:
    return float((w * np.abs(s * x + t - y)).sum())


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(3, 80),
    noise=st.sampled_from([0.0, 0.1, 1.0]),
    rounded=st.booleans(),
)
def test_fit_is_as_good_as_a_linear_program(
    seed: int, count: int, noise: float, rounded: bool
) -> None:
    rng = np.random.default_rng(seed)
    x = rng.gamma(2, 1, count)
    y = rng.uniform(-2, 3) * x + rng.uniform(-3, 3) + noise * rng.standard_t(1.5, count)
    if rounded:
        x, y = np.round(x, 1), np.round(y, 1)
    w = rng.uniform(0.01, 1, count)
    ours, theirs = fit_scale_shift(x, y, w), linear_program(x, y, w)
    assert l1(*ours, x, y, w) <= l1(*theirs, x, y, w) * (1 + 1e-9) + 1e-9


@pytest.mark.parametrize("decimals", [None, 2])
def test_fit_of_many_samples_cannot_be_improved(decimals: int | None) -> None:
    rng = np.random.default_rng(1)
    x = rng.gamma(2, 1, 100_000)
    y = 1.7 * x + 0.3 + 0.2 * rng.standard_t(1.5, x.size)
    if decimals is not None:
        x, y = np.round(x, decimals), np.round(y, decimals)
    w = 1 / np.abs(y).clip(0.1)
    s, t = fit_scale_shift(x, y, w)
    best = l1(s, t, x, y, w)
    for ds, dt in [(1, 0), (-1, 0), (0, 1), (0, -1), (1, -2), (-1, 2), (1, -1.5), (-1, 1.5)]:
        for size in (1e-6, 1e-4, 1e-2, 1.0):
            assert l1(s + size * ds, t + size * dt, x, y, w) >= best * (1 - 1e-12)


def test_fit_recovers_an_exact_relation_despite_outliers() -> None:
    rng = np.random.default_rng(2)
    x = rng.uniform(1, 9, 30_000)
    y = 0.25 * x - 1.5
    y[::3] += rng.uniform(0, 50, len(y[::3]))
    np.testing.assert_allclose(fit_scale_shift(x, y), (0.25, -1.5), atol=1e-9)


def test_fit_of_a_constant_prediction_moves_it_to_the_weighted_median() -> None:
    scale, shift = fit_scale_shift(np.full(3, 2.0), np.array([1.0, 5.0, 9.0]), np.array([1, 1, 3]))
    assert scale * 2 + shift == 9


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.ones(3), np.ones(4)), "3, 4 and 3"),
        ((np.array([1.0, np.nan]), np.ones(2)), "prediction holds values that are not finite"),
        ((np.ones(2), np.ones(2), np.array([1.0, -1.0])), "negative"),
        ((np.ones(2), np.ones(2), np.zeros(2)), "no sample has a positive weight"),
    ],
)
def test_fit_says_what_is_wrong_with_its_input(
    arguments: tuple[np.ndarray, ...], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        fit_scale_shift(*arguments)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), trunc=st.sampled_from(TRUNCS))
def test_scale_is_the_best_of_all_kinks(seed: int, trunc: float | None) -> None:
    """The objective is piecewise linear, so that one of the y / x is a minimum."""
    x, y, w = normal(seed, 3, 7, dtype=torch.float64)
    w = w.clamp(min=0)
    scale, error = align_scale(x, y, w, trunc)
    kinks = y / x
    errors = w * (kinks[:, None] * x - y).abs()
    errors = (errors if trunc is None else errors.clamp(max=trunc)).sum(-1)
    if (w > 0).any():
        torch.testing.assert_close(error, errors[w > 0].min())
    else:
        assert scale == 0


def test_frame_without_any_weight_gets_scale_and_shift_zero() -> None:
    points = uniform(0, 2, 6, 3)
    weight = torch.ones(2, 6)
    weight[1] = 0
    scale, shift = align_points(points, 2 * points, weight, "z", 1.0)
    torch.testing.assert_close(scale, torch.tensor([2.0, 0.0]))
    assert not shift[1].any()


def golden_case(golden_losses: Path, name: str) -> dict[str, Tensor]:
    with np.load(golden_losses) as arrays:
        found = {
            key.removeprefix(f"{name}/"): torch.from_numpy(arrays[key]).double()
            for key in arrays.files
            if key.startswith(f"{name}/")
        }
    assert found, f"no golden case {name}"
    lead = found["in/w"].dim() - 1
    batch = found["in/w"].shape[:-1].numel()
    return {key: value.reshape(batch, *value.shape[lead:]) for key, value in found.items()}


@pytest.mark.parametrize("trunc", TRUNCS)
@pytest.mark.parametrize("rep", [0, 1, 2])
def test_solvers_match_the_golden_ones(golden_losses: Path, rep: int, trunc: float | None) -> None:
    def case(name: str) -> tuple[tuple[Tensor, Tensor, Tensor], dict[str, Tensor]]:
        found = golden_case(golden_losses, f"{name}/rep{rep}_trunc{trunc}")
        keys = ("x", "y", "w") if name == "align" else ("src", "tgt", "w")
        return tuple(found[f"in/{key}"] for key in keys), found  # type: ignore[return-value]

    near = {"rtol": 2e-5, "atol": 2e-5}
    inputs, found = case("align")
    scale, error = align_scale(*inputs, trunc)
    torch.testing.assert_close(scale, found["out/a"], **near)
    torch.testing.assert_close(error, found["out/loss"], **near)
    inputs, found = case("align_depth_affine")
    scale, shift = align_scale_shift(*inputs, trunc)
    torch.testing.assert_close(scale, found["out/scale"], **near)
    torch.testing.assert_close(shift, found["out/shift"], **near)
    inputs, found = case("align_points_scale")
    scale, _ = align_points(*inputs, "none", trunc)
    torch.testing.assert_close(scale, found["out/scale"], **near)
    inputs, found = case("align_depth_scale")
    torch.testing.assert_close(align_scale(*inputs, trunc)[0], found["out/scale"], **near)
    for axes in ("z", "xyz"):
        inputs, found = case(f"align_points_scale_{axes}_shift")
        scale, shift = align_points(*inputs, axes, trunc)
        torch.testing.assert_close(scale, found["out/scale"], **near)
        torch.testing.assert_close(shift, found["out/shift"], **near)
    inputs, found = case("align_points_xyz_shift")
    torch.testing.assert_close(align_points_shift(*inputs, trunc), found["out/shift"], **near)
    (points, target, weight), found = case("align_points_z_shift")
    shift = align_points_shift(points[..., 2:], target[..., 2:], weight, trunc)
    torch.testing.assert_close(shift, found["out/shift"][..., 2:], **near)
