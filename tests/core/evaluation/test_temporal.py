"""Temporal alignment error and flicker: zero where they must be, and by hand where not."""

from __future__ import annotations

import numpy as np
import pytest

from dyfn_core.evaluation.temporal import (
    PosedCamera,
    TemporalScorer,
    flicker,
    reprojection_error,
    static_pixels,
    temporal_alignment_error,
)
from dyfn_core.prediction import DEPTH, DISPARITY

SIZE = (48, 64)
MATRIX = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])


def at(x: float = 0, z: float = 0) -> PosedCamera:
    where = np.eye(4)
    where[:3, 3] = [x, 0, z]
    return PosedCamera(MATRIX, where)


def wall(distance: float) -> np.ndarray:
    """A wall across the view; a camera that comes nearer by dz sees it at distance - dz."""
    return np.full(SIZE, distance)


def test_a_wall_that_the_camera_approaches_has_no_error() -> None:
    error = temporal_alignment_error(wall(4.0), wall(3.5), at(), at(z=0.5))
    assert error == pytest.approx(0, abs=1e-12)


def test_a_wrong_scale_is_measured_in_both_directions() -> None:
    """Frame k says 4 m, frame k + 1 says 3.85 m after half a metre: 3.5 m and 4.35 m expected."""
    first, second = wall(4.0), wall(3.85)
    there = reprojection_error(first, second, at(), at(z=0.5))
    back = reprojection_error(second, first, at(z=0.5), at())
    assert there is not None and back is not None
    assert there[0] == pytest.approx(0.35 / 3.85)
    assert back[0] == pytest.approx(0.35 / 4.0)
    mean = temporal_alignment_error(first, second, at(), at(z=0.5))
    assert mean == pytest.approx((there[0] + back[0]) / 2)


def test_sideways_motion_moves_pixels_and_invalid_ones_do_not_count() -> None:
    """0.2 m to the right at 4 m and f = 60 are 3 pixels to the left."""
    first = wall(4.0)
    first[:, :20] = np.nan
    found = reprojection_error(first, wall(4.0), at(), at(x=0.2))
    assert found is not None
    assert found == (pytest.approx(0), SIZE[0] * (SIZE[1] - 20))
    second = wall(4.0)
    second[10:] = 0
    found = reprojection_error(first, second, at(), at(x=0.2))
    assert found is not None and found[1] == 10 * 44


def test_the_nearer_of_two_points_on_one_pixel_counts() -> None:
    """The near half hides what is behind it: with the far one on top the error would be large."""
    first = wall(8.0)
    first[:, 32:] = 2.0
    second = wall(8.0)
    second[:, 26:] = 2.0  # 0.2 m to the right: near points move by 6 pixels, far ones by 1.5
    found = reprojection_error(first, second, at(), at(x=0.2))
    assert found is not None and found[0] == pytest.approx(0, abs=1e-12)


def test_points_behind_the_camera_and_outside_the_image_do_not_count() -> None:
    assert reprojection_error(wall(1.0), wall(1.0), at(), at(z=2.0)) is None
    assert reprojection_error(wall(4.0), wall(4.0), at(), at(x=50.0)) is None


def test_static_pixels_are_those_that_stay() -> None:
    truth, nearer = wall(4.0), wall(4.0)
    nearer[:, :10] = 3.9  # 2.5% nearer: something moved there
    nearer[:5] = np.nan
    static = static_pixels(truth, nearer)
    assert static.sum() == (SIZE[0] - 5) * (SIZE[1] - 10)
    assert static_pixels(truth, truth, (at(), at(x=0.05))).all()  # 0.75 pixels
    assert not static_pixels(truth, truth, (at(), at(x=0.1))).any()  # 1.5 pixels
    grey = np.full(SIZE, 100.0)
    brighter = grey.copy()
    brighter[:, 40:] += 9
    assert static_pixels(truth, truth, None, (grey, brighter)).sum() == SIZE[0] * 40


def test_flicker_is_the_relative_change_of_static_pixels() -> None:
    static = np.zeros(SIZE, bool)
    static[:, :8] = True
    second = wall(5.0)
    second[:, :8] = 4.2
    assert flicker(wall(4.0), second, static) == pytest.approx(0.05)
    assert flicker(wall(4.0), second, np.zeros(SIZE, bool)) is None


def push(
    scorer: TemporalScorer, truth: np.ndarray, maps: dict[str, np.ndarray], view: PosedCamera | None
) -> None:
    image = np.zeros((*SIZE, 3), np.uint8)
    pose = None if view is None else view.pose
    scorer.push(image, truth, maps, MATRIX, pose)


def test_the_scorer_aligns_first_and_knows_disparity() -> None:
    """`good` is truth after its alignment, `bad` jumps by 10% at every second frame."""
    with TemporalScorer(samples=800) as scorer:
        for index in range(4):
            truth = wall(4.0 - 0.25 * index)
            jump = 1.1 if index % 2 else 1.0
            maps = {"good": (truth - 1) / 2, "bad": truth * jump, "inverse": 3 / truth}
            push(scorer, truth, maps, at(z=0.25 * index))
        found = scorer.results(
            {"good": (2, 1, DEPTH), "bad": (1, 0, DEPTH), "inverse": (1 / 3, 0, DISPARITY)}
        )
    assert list(found) == ["truth", "good", "bad", "inverse"]
    for name in ("truth", "good", "inverse"):
        assert found[name]["tae"] == pytest.approx(0, abs=1e-6), name
        assert found[name]["tae_pairs"] == 3
        assert found[name]["flicker"] is None  # the camera moves: nothing stands still
    assert found["bad"]["tae"] == pytest.approx(0.1, rel=0.1)


def test_without_poses_there_is_flicker_and_no_alignment_error() -> None:
    with TemporalScorer() as scorer:
        for index in range(3):
            push(scorer, wall(4.0), {"a": wall(4.0 + 0.2 * (index % 2))}, None)
        found = scorer.results({"a": (1, 0, DEPTH)})
    assert found["a"]["tae"] is None and found["a"]["tae_pairs"] == 0
    assert found["a"]["flicker"] == pytest.approx((0.2 / 4 + 0.2 / 4.2) / 2)
    assert found["truth"]["flicker"] == 0 and found["truth"]["flicker_pairs"] == 2


def test_the_grid_of_the_scorer_keeps_the_geometry() -> None:
    """A slope under known motion: the coarse grid agrees with the full image within its steps."""
    rows = np.arange(SIZE[0])[:, None] * np.ones(SIZE)
    ground = 60 * 1.5 / np.maximum(rows - 23.5, 2)  # a floor 1.5 m below the camera
    with TemporalScorer(samples=SIZE[0] * SIZE[1] // 9) as scorer:
        for index in range(3):
            push(scorer, ground, {"a": ground}, at(x=0.1 * index))
        found = scorer.results({"a": (1, 0, DEPTH)})
    assert found["a"]["tae"] == pytest.approx(0, abs=1e-6)  # sideways a floor looks the same
