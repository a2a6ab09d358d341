"""Intrinsics, rays, and focal and shift from affine points."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from dyfn_core.geometry.camera import (
    check_camera_matrix,
    depth_to_points,
    focal_from_fov,
    intrinsics_from_focal,
    normalize_intrinsics,
    pixel_intrinsics,
    project,
    recover_focal_shift,
    sampled_uv,
    solve_focal_shift,
    uv_grid,
)
from tests.support.seeded import uniform


def scene(seed: int, count: int = 1024, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points (N x 3) and their view-plane positions (N x 2) for focal 1.3, no shift."""
    rng = np.random.default_rng(seed)
    uv = sampled_uv(60, 80)[rng.choice(4096, count, replace=False)]
    z = np.exp(rng.normal(0.5, 0.4, count))
    xyz = np.column_stack([uv * z[:, None] / 1.3, z])
    xyz[:, :2] += rng.normal(0, noise, (count, 2)) * z[:, None]
    return xyz, uv


def cost(xyz: np.ndarray, uv: np.ndarray, focal: float, shift: float) -> float:
    return float(np.square(focal * xyz[:, :2] / (xyz[:, 2:] + shift) - uv).sum())


@given(st.integers(0, 10_000), st.floats(-0.3, 3.0))
@settings(max_examples=30, deadline=None)
def test_focal_and_shift_of_exact_points_come_back(seed: int, shift: float) -> None:
    xyz, uv = scene(seed)
    shift = max(shift, 0.05 - xyz[:, 2].min())
    found = solve_focal_shift(xyz - [0, 0, shift], uv)
    assert found.solved
    assert found.shift == pytest.approx(shift, abs=1e-7)
    assert found.focal == pytest.approx(1.3, rel=1e-7)
    known = solve_focal_shift(xyz - [0, 0, shift], uv, focal=1.3)
    assert known.shift == pytest.approx(shift, abs=1e-7)


@pytest.mark.parametrize("known", [None, 1.3, 0.9])
@pytest.mark.parametrize("seed", range(6))
def test_solution_is_the_optimum_of_noisy_points(seed: int, known: float | None) -> None:
    xyz, uv = scene(seed, noise=0.05)

    def residual(shift: np.ndarray) -> np.ndarray:
        rays = xyz[:, :2] / (xyz[:, 2:] + shift)
        focal = (rays * uv).sum() / (rays * rays).sum() if known is None else known
        return (focal * rays - uv).ravel()

    reference = least_squares(residual, 0.0, method="lm", ftol=1e-15, xtol=1e-15, gtol=1e-15)
    found = solve_focal_shift(xyz, uv, known)
    assert cost(xyz, uv, found.focal, found.shift) <= 2 * reference.cost * (1 + 1e-9)
    assert found.shift == pytest.approx(reference.x[0], abs=1e-5)


def test_solver_is_scale_free() -> None:
    xyz, uv = scene(0, noise=0.05)
    one, small = solve_focal_shift(xyz, uv), solve_focal_shift(xyz * 1e-6, uv)
    assert small.focal == pytest.approx(one.focal, rel=1e-9)
    assert small.shift == pytest.approx(one.shift * 1e-6, rel=1e-6)


def test_a_plane_facing_the_camera_keeps_its_depth() -> None:
    uv = sampled_uv(60, 80)
    xyz = np.column_stack([uv * 2.0, np.full(len(uv), 2.6)])
    found = solve_focal_shift(xyz, uv)
    assert found.solved
    assert found.shift == pytest.approx(0.0, abs=1e-9)
    assert found.focal == pytest.approx(1.3)
    assert solve_focal_shift(xyz, uv, focal=2.6).shift == pytest.approx(2.6, rel=1e-6)


@pytest.mark.parametrize("known", [None, 1.7])
def test_points_that_say_nothing_give_no_shift(known: float | None) -> None:
    xyz, uv = scene(0)
    mirrored = xyz * [-1, -1, 1]
    for points, where in ((xyz[:1], uv[:1]), (xyz[:0], uv[:0]), (mirrored, uv)):
        found = solve_focal_shift(points, where, known)
        assert not found.solved
        assert (found.focal, found.shift) == (known or 1.0, 0.0)


@pytest.mark.parametrize("size", [(48, 64), (203, 317), (64, 64), (1, 90), (500, 7)])
def test_recovery_from_point_maps_of_any_size(size: tuple[int, int]) -> None:
    height, width = size
    rng = np.random.default_rng(0)
    depth = torch.from_numpy(rng.uniform(1, 3, (2, height, width)))
    focal = torch.tensor([0.8, 2.0], dtype=torch.float64)
    points = depth_to_points(depth, intrinsics_from_focal(focal, width / height))
    points[..., 2] -= 0.5
    got_focal, got_shift = recover_focal_shift(points)
    np.testing.assert_allclose(got_focal.numpy(), focal.numpy(), rtol=1e-6)
    np.testing.assert_allclose(got_shift.numpy(), 0.5, atol=1e-6)


def test_masked_and_infinite_points_have_no_say() -> None:
    rng = np.random.default_rng(0)
    depth = torch.from_numpy(rng.uniform(1, 3, (1, 40, 60)))
    points = depth_to_points(depth, intrinsics_from_focal(torch.tensor([1.1]).double(), 1.5))
    mask = torch.ones(1, 40, 60, dtype=torch.bool)
    mask[:, :10] = False
    points[:, :10] = 77.0
    points[:, 12:15] = math.inf
    points[:, 15:17] = math.nan
    focal, shift = recover_focal_shift(points, mask)
    assert focal.item() == pytest.approx(1.1, rel=1e-6)
    assert shift.item() == pytest.approx(0.0, abs=1e-6)
    focal, shift = recover_focal_shift(points, torch.zeros_like(mask))
    assert (focal.item(), shift.item()) == (1.0, 0.0)


def test_pixel_and_normalised_intrinsics_undo_each_other() -> None:
    matrix = np.array([[500.0, 0, 310], [0, 505.0, 260], [0, 0, 1]])
    normal = normalize_intrinsics(matrix, (480, 640))
    np.testing.assert_allclose(pixel_intrinsics(normal, (480, 640)), matrix)
    # The pixel at the principal point has its centre there, half a pixel into the image's frame.
    assert normal[0, 2] * 640 == pytest.approx(310.5)


def test_unprojected_points_project_back_onto_their_pixels() -> None:
    matrix = np.array([[50.0, 0, 29], [0, 55.0, 25], [0, 0, 1]])
    intrinsics = torch.from_numpy(normalize_intrinsics(matrix, (48, 64)))[None]
    depth = uniform(0, 1, 48, 64, dtype=torch.float64) + 1
    points = depth_to_points(depth, intrinsics)
    pixels = (points[0] @ torch.from_numpy(matrix).T).numpy()
    pixels = pixels[..., :2] / pixels[..., 2:]
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(pixels[..., 0], u, atol=1e-9)
    np.testing.assert_allclose(pixels[..., 1], v, atol=1e-9)
    normal = project(points, intrinsics)[0].numpy()
    np.testing.assert_allclose(normal[..., 0] * 64 - 0.5, u, atol=1e-9)


def test_field_of_view_round_trip() -> None:
    focal = focal_from_fov(60.0, 4 / 3, 1)
    matrix = intrinsics_from_focal(focal, 4 / 3)[0].tolist()
    assert 0.5 / matrix[0][0] == pytest.approx(math.tan(math.radians(30)))
    assert 0.5 / matrix[1][1] == pytest.approx(math.tan(math.radians(30)) * 3 / 4)


@pytest.mark.parametrize("fov", [0.0, 180.0, -5.0, math.nan, [60.0, 200.0], [60.0, 60.0, 60.0]])
def test_bad_field_of_view_is_refused(fov: float) -> None:
    with pytest.raises(ValueError, match="fov_x"):
        focal_from_fov(torch.tensor(fov), 1.0, 2)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(4), "3 x 3"),
        (np.diag([0.0, 5, 1]), "positive focal"),
        (np.diag([5.0, -5, 1]), "positive focal"),
        (np.diag([math.nan, 5, 1]), "not finite"),
        (np.array([[5.0, 0.1, 0], [0, 5, 0], [0, 0, 1]]), "fx 0 cx"),
        (np.diag([5.0, 5, 2]), "fx 0 cx"),
    ],
)
def test_bad_camera_matrix_is_refused(matrix: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_camera_matrix(matrix)


def test_view_plane_grid_has_its_corners_on_the_unit_circle() -> None:
    grid = uv_grid((3, 4), dtype=torch.float64)
    assert grid.shape == (2, 3, 4)
    assert grid[0, 0, 0].item() == pytest.approx(-0.8 * 3 / 4)
    assert grid[1, 2, 0].item() == pytest.approx(0.6 * 2 / 3)
    wide = uv_grid((3, 4), aspect=2.0, dtype=torch.float64)
    assert wide[0, 0, -1].item() == pytest.approx(2 / math.sqrt(5) * 3 / 4)
