"""Triangulation of made tracks: exact ones give the truth, noisy ones err as they state."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dyfn_core.geometry.triangulation import Triangulated, Views, triangulate

PIXEL = 1 / 250.0  # focal length of 250 pixels
VIEWS = 8
START = np.eye(3), np.zeros(3)


def made(
    points: int = 300, step: float = 0.06, turn: float = 0.01, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, Views]:
    """Depth N, coordinates now N x 2, and what VIEWS earlier pictures saw of the points."""
    draw = np.random.default_rng(seed)
    depth = draw.uniform(1.0, 5.0, points)
    present = draw.uniform(-0.5, 0.5, (points, 2))
    place = np.column_stack([present, np.ones(points)]) * depth[:, None]
    order = np.arange(1, VIEWS + 1)
    rotation = np.stack([cv2.Rodrigues(np.array([0.3, 1.0, 0.2]) * turn * k)[0] for k in order])
    translation = np.array([1.0, 0.2, -0.3]) * step * order[:, None]
    there = np.einsum("kij,nj->nki", rotation, place) + translation
    seen = there[..., :2] / there[..., 2:]
    return depth, present, Views(rotation, translation, seen, np.zeros(VIEWS), np.zeros(VIEWS))


def seen_with(present: np.ndarray, views: Views, **changes: np.ndarray) -> Triangulated:
    parts = {name: getattr(views, name) for name in views.__dataclass_fields__}
    return triangulate(present, Views(**{**parts, **changes}), PIXEL)


def test_exact_tracks_give_the_depth() -> None:
    depth, present, views = made()
    found = triangulate(present, views, PIXEL)
    assert np.abs(found.depth / depth - 1).max() < 1e-6
    assert found.rms.max() < 1e-6
    assert (found.views == VIEWS + 1).all()


def test_views_that_did_not_see_a_point_are_left_out() -> None:
    depth, present, views = made()
    points = views.points.copy()
    points[np.random.default_rng(1).random(points.shape[:2]) < 0.5] = np.nan
    found = seen_with(present, views, points=points)
    seen = np.isfinite(points[..., 0]).sum(axis=1)
    assert (found.views == seen + 1).all()
    assert np.abs(found.depth / depth - 1)[seen > 0].max() < 1e-6
    assert np.isnan(found.depth[seen == 0]).all()  # one picture says nothing
    assert np.isinf(found.sigma_pixels[seen == 0]).all()


def spread(errors: np.ndarray) -> float:
    """Standard deviation of normalised errors, outliers beyond 5 left out and limited in number.

    4000 independent errors fix it within 1 / sqrt(8000) = 1.1%; the bounds of 10% also cover the
    second order of log depth at sigmas of up to 0.1.
    """
    assert np.mean(np.abs(errors) > 5) < 0.002
    return float(errors[np.abs(errors) <= 5].std())


def test_errors_by_pixel_noise_are_as_large_as_stated() -> None:
    noise = 0.5
    depth, present, views = made(4000)
    draw = np.random.default_rng(2)
    points = views.points + draw.normal(0, noise * PIXEL, views.points.shape)
    noisy = present + draw.normal(0, noise * PIXEL, present.shape)
    found = seen_with(noisy, views, points=points)
    sigma = noise * found.sigma_pixels
    good = sigma < 0.1
    assert good.mean() > 0.9
    errors = (np.log(found.depth / depth) / sigma)[good]
    assert spread(errors) == pytest.approx(1.0, abs=0.1)
    assert abs(errors.mean()) < 0.1


def test_errors_by_pose_noise_are_as_large_as_stated() -> None:
    turn, shift = 1e-3, 2e-3  # radians and metres a step
    errors = []
    for seed in range(100):  # a walk of poses errs alike for all its points
        depth, present, views = made(40, seed=seed)
        draw = np.random.default_rng(1000 + seed)
        rotation, translation = np.eye(3), np.zeros(3)
        rotations, translations = [], []
        for k in range(VIEWS):  # step k of the walk, after the camera of view k - 1
            before = (views.rotation[k - 1], views.translation[k - 1]) if k else START
            step_r = views.rotation[k] @ before[0].T
            step_t = views.translation[k] - step_r @ before[1]
            step_r = cv2.Rodrigues(draw.normal(0, turn, 3))[0] @ step_r
            step_t = step_t + draw.normal(0, shift, 3)
            rotation, translation = step_r @ rotation, step_r @ translation + step_t
            rotations.append(rotation)
            translations.append(translation)
        found = seen_with(
            present,
            views,
            rotation=np.stack(rotations),
            translation=np.stack(translations),
            rotation_variance=np.full(VIEWS, turn**2),
            translation_variance=np.full(VIEWS, shift**2),
        )
        good = found.sigma_poses < 0.1
        errors.append((np.log(found.depth / depth) / found.sigma_poses)[good])
    together = np.concatenate(errors)
    # 100 walks with about 3 to 6 free directions each fix a standard deviation within 1 / sqrt(600)
    # to 1 / sqrt(1200), 3 to 4%; 15% is beyond three of those and the second order.
    assert len(together) > 3000
    assert spread(together) == pytest.approx(1.0, abs=0.15)


def test_pose_noise_grows_with_its_variance() -> None:
    _, present, views = made()
    one, four = (
        seen_with(present, views, rotation_variance=np.full(VIEWS, v)).sigma_poses
        for v in (1e-6, 4e-6)
    )
    np.testing.assert_allclose(four, 2 * one, rtol=1e-9)


def test_outlier_in_one_view_does_not_spoil_a_point() -> None:
    depth, present, views = made()
    points = views.points.copy()
    points[:, 3] += 40 * PIXEL
    found = seen_with(present, views, points=points)
    plain = np.abs(np.log(found.depth / depth))
    assert np.median(plain) < 0.08
    assert np.median(found.rms) > 5


def test_pure_rotation_gives_no_point() -> None:
    _, present, still = made(step=0.0)
    found = seen_with(present, still)
    assert np.isnan(found.depth).all()
    assert np.isinf(found.sigma_pixels).all()


def test_standing_still_gives_no_certain_point() -> None:
    _, present, still = made(step=0.0, turn=0.0)
    points = still.points + np.random.default_rng(3).normal(0, 0.3 * PIXEL, still.points.shape)
    found = seen_with(present, still, points=points)
    assert not (found.sigma_pixels < 1.0).any()


def test_points_behind_a_camera_are_refused() -> None:
    _, present, views = made()
    found = seen_with(present, views, translation=-views.translation)
    assert np.isnan(found.depth).mean() > 0.9  # the tracks cross behind the cameras
