"""The field of log scale against fields that are known."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from dyfn_core.metric.scale_field import FieldOptions, scale_field

SIZE = (120, 160)
OPTIONS = FieldOptions()


def points(number: int = 200, seed: int = 0) -> np.ndarray:
    """N x 2 pixels (x, y) all over the picture."""
    draw = np.random.default_rng(seed)
    return draw.uniform([0, 0], [SIZE[1] - 1, SIZE[0] - 1], (number, 2))


def smooth(pixels: np.ndarray) -> np.ndarray:
    """A field of log scale, here of x and y."""
    x, y = pixels[..., 0] / SIZE[1], pixels[..., 1] / SIZE[0]
    return np.asarray(0.15 * np.sin(3 * x) - 0.1 * y)


def everywhere() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(SIZE[1]), np.arange(SIZE[0])), axis=-1)


def test_smooth_field_is_found() -> None:
    where = points()
    found = scale_field(where, smooth(where), np.full(200, 0.02), np.full(SIZE, 2.0), OPTIONS)
    error = found - smooth(everywhere())
    assert found.dtype == np.float32
    assert np.sqrt((error**2).mean()) < 0.01
    assert np.abs(error[10:-10, 10:-10]).max() < 0.03


def test_noise_is_averaged_and_uncertain_points_say_less() -> None:
    where, draw = points(), np.random.default_rng(1)
    values = 0.1 + draw.normal(0, 0.1, 200)
    fine = scale_field(where, values, np.full(200, 0.1), np.full(SIZE, 2.0), OPTIONS)
    coarse = scale_field(where, values, np.full(200, 10.0), np.full(SIZE, 2.0), OPTIONS)
    assert np.abs(fine - 0.1).mean() < 0.04
    assert np.abs(coarse).max() < 0.02  # the prior, 0


def test_far_from_all_points_there_is_no_correction() -> None:
    where = np.array([[10.0, 10.0]] * 8)
    found = scale_field(where, np.full(8, 0.2), np.full(8, 0.05), np.full(SIZE, 2.0), OPTIONS)
    assert found[10, 10] == pytest.approx(0.2, abs=0.03)
    assert abs(found[-1, -1]) < 0.01


def test_outliers_are_held_back() -> None:
    where = points()
    values = np.full(200, 0.1)
    values[::10] = 1.5
    found = scale_field(where, values, np.full(200, 0.1), np.full(SIZE, 2.0), OPTIONS)
    assert np.median(found) == pytest.approx(0.1, abs=0.05)


def test_near_and_far_surfaces_are_told_apart() -> None:
    depth = np.full(SIZE, 1.0)
    depth[:, 80:] = 8.0
    where = points(300)
    near = where[:, 0] < 80
    values = np.where(near, 0.2, -0.2)
    flat = scale_field(where, values, np.full(300, 0.05), np.full(SIZE, 1.0), OPTIONS)
    found = scale_field(where, values, np.full(300, 0.05), depth, OPTIONS)
    edge = np.s_[20:-20, 72:88]
    wanted = np.where(everywhere()[..., 0] < 80, 0.2, -0.2)[edge]
    assert np.abs(found[edge] - wanted).mean() < 0.7 * np.abs(flat[edge] - wanted).mean()


def test_no_points_and_no_prediction_give_no_correction() -> None:
    empty = np.empty(0)
    assert not scale_field(np.empty((0, 2)), empty, empty, np.ones(SIZE), OPTIONS).any()
    unknown = np.full(SIZE, np.nan)
    where = points(20)
    found = scale_field(where, np.full(20, 0.1), np.full(20, 0.1), unknown, OPTIONS)
    assert np.isfinite(found).all()


def test_small_pictures_and_many_points() -> None:
    where = np.array([[1.0, 1.0], [3.0, 0.0]])
    found = scale_field(where, np.full(2, 0.1), np.full(2, 0.01), np.ones((3, 5)), OPTIONS)
    assert found.shape == (3, 5)
    where = points(900)
    noise = np.full(900, 0.05)
    noise[500:] = 5.0
    values = np.where(noise > 1, 9.0, 0.1)  # only the most certain 400 count
    found = scale_field(where, values, noise, np.full(SIZE, 2.0), OPTIONS)
    assert np.abs(found - 0.1).max() < 0.05


def test_points_of_what_moves_are_held_back_where_noise_is_shared() -> None:
    """A third of the points in one corner are wrong; the rest say 0.1."""
    where, draw = points(300), np.random.default_rng(2)
    corner = (where[:, 0] < 80) & (where[:, 1] < 60)
    wrong = corner & (draw.random(300) < 0.33)
    values = np.where(wrong, -0.9, 0.1)
    sigma = np.full(300, 0.1)
    shape = np.full(SIZE, 2.0)
    robust = scale_field(where, values, 1.5 * sigma, shape, OPTIONS, sigma)
    assert wrong.sum() > 15
    assert np.median(robust[:60, :80]) == pytest.approx(0.1, abs=0.08)


ONE_FIELD = """
import hashlib, sys
import numpy as np
from dyfn_core.metric.scale_field import FieldOptions, scale_field
draw = np.random.default_rng(0)
pixels, residuals = draw.uniform(0, [319, 239], (400, 2)), draw.normal(0, 0.1, 400)
depth = draw.uniform(1, 4, (240, 320)).astype(np.float32)
field = scale_field(pixels, residuals, draw.uniform(0.1, 0.3, 400), depth, FieldOptions())
print(hashlib.sha256(field.tobytes()).hexdigest())
"""


def test_the_field_is_the_same_on_any_number_of_threads() -> None:
    """A node with one thread and a replay with several give the same bytes."""
    found = {
        subprocess.run(
            [sys.executable, "-c", ONE_FIELD],
            env={**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "2", "3")
    }
    assert len(found) == 1
