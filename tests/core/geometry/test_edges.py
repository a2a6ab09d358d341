"""Flying pixels: what hangs between two surfaces, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_core.geometry.edges import flying_pixels

ALL = np.ones((6, 8), bool)


def step(near: float = 1.0, far: float = 2.0) -> np.ndarray:
    depth = np.full((6, 8), near)
    depth[:, 4:] = far
    return depth


def test_both_sides_of_a_step_are_marked_and_nothing_else() -> None:
    marked = flying_pixels(step(), ALL, 0.05)
    assert marked[:, 3:5].all()
    assert marked.sum() == 12
    assert np.array_equal(flying_pixels(step().T, ALL.T, 0.05), marked.T)


def test_a_ramp_between_surfaces_is_marked_whole() -> None:
    depth = step()
    depth[:, 4] = 1.5
    assert np.flatnonzero(flying_pixels(depth, ALL, 0.05)[0]).tolist() == [3, 4, 5]


@pytest.mark.parametrize(("share", "found"), [(0.05, False), (0.03, True)])
def test_the_share_is_of_the_nearer_depth(share: float, found: bool) -> None:
    assert flying_pixels(step(10.0, 10.4), ALL, share).any() is np.bool_(found)


def test_pixels_that_are_not_valid_neither_are_marked_nor_mark() -> None:
    depth, valid = step(), ALL.copy()
    depth[:, 4:], valid[:, 4:] = np.nan, False
    assert not flying_pixels(depth, valid, 0.05).any()


def test_a_smooth_slope_stays() -> None:
    depth = 1 / np.linspace(1.0, 0.8, 8)[None].repeat(6, 0)
    assert not flying_pixels(depth, ALL, 0.05).any()
