"""Camera and projection against the released MoGe, from a recorded point map, without weights."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from dyfn_core.geometry.camera import (
    depth_to_points,
    focal_from_fov,
    intrinsics_from_focal,
    project,
    solve_focal_shift,
)

SIZE = (240, 320)
ASPECT = SIZE[1] / SIZE[0]
CASES = ["infer_fovNone_projTrue", "infer_fovNone_projFalse", "infer_fov60_projTrue"]

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def golden(golden_file: Callable[[str], Path]) -> Arrays:
    found = np.load(golden_file("C_320x240_frame0.npz"))
    return {key.removeprefix("tok300."): found[key] for key in found.files}


def samples(golden: Arrays) -> tuple[np.ndarray, np.ndarray]:
    """Every valid point of the stored map (every second pixel) and where it is in the view."""
    points = golden["forward.points"].astype(np.float64)
    valid = golden["infer.mask"][0, ::2, ::2]
    v, u = ((2 * np.arange(0, side, 2) + 1 - side) / np.hypot(*SIZE) for side in SIZE)
    uv = np.stack(np.meshgrid(u, v), axis=-1)
    return points[valid], uv[valid]


def test_focal_and_shift_are_the_released_ones(golden: Arrays) -> None:
    """To 1%: the released solver took other samples, and this map is of random weights."""
    found = solve_focal_shift(*samples(golden))
    focal, shift = golden["infer_fovNone_projTrue.focal_shift"][0]
    assert found.solved
    assert found.focal == pytest.approx(focal, rel=0.01)
    assert found.shift == pytest.approx(shift, abs=0.01)


def test_shift_of_a_known_field_of_view_is_the_released_one(golden: Arrays) -> None:
    focal, shift = golden["infer_fov60_projTrue.focal_shift"][0]
    known = float(focal_from_fov(60, ASPECT, 1)[0])
    assert known == pytest.approx(focal, rel=1e-6)
    assert solve_focal_shift(*samples(golden), known).shift == pytest.approx(shift, rel=0.01)


@pytest.mark.parametrize("case", CASES)
def test_intrinsics_are_those_of_the_focal(golden: Arrays, case: str) -> None:
    focal = torch.tensor(golden[f"{case}.focal_shift"][:, 0])
    wanted = torch.from_numpy(golden[f"{case}.intrinsics"]).double()
    torch.testing.assert_close(intrinsics_from_focal(focal, ASPECT), wanted, rtol=1e-6, atol=1e-7)


def test_points_are_the_shifted_map(golden: Arrays) -> None:
    case = "infer_fovNone_projFalse"
    points = golden["forward.points"][::2, ::2].astype(np.float64)
    points[..., 2] += golden[f"{case}.focal_shift"][0, 1]
    found = golden[f"{case}.points"][0]
    seen = np.isfinite(found).all(axis=-1)
    assert seen.mean() > 0.6
    np.testing.assert_allclose(found[seen], points[seen], rtol=1e-5, atol=1e-5)


def test_forced_projection_is_depth_along_the_pixel_rays(golden: Arrays) -> None:
    case = "infer_fovNone_projTrue"
    intrinsics = torch.from_numpy(golden[f"{case}.intrinsics"])
    points = depth_to_points(torch.from_numpy(golden[f"{case}.depth"]), intrinsics)[:, ::4, ::4]
    wanted = torch.from_numpy(golden[f"{case}.points"])
    seen = torch.isfinite(wanted).all(dim=-1)
    torch.testing.assert_close(points[seen], wanted[seen], rtol=1e-5, atol=1e-5)
    v, u = ((torch.arange(0, side, 4) + 0.5) / side for side in SIZE)
    pixels = torch.stack([u.expand(60, 80), v[:, None].expand(60, 80)], dim=-1)[None]
    torch.testing.assert_close(project(wanted, intrinsics)[seen], pixels[seen], rtol=0, atol=1e-5)
