"""The memory of scale: predictions whose scale flickers, over pictures of a textured plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dyfn_core.metric.scale_memory import ScaleMemoryOptions, ScaleMemoryState, step
from tests.support.textured_plane import CAMERA, SIZE, PlaneView, plane_view, pose_at, texture, walk

HOW = ScaleMemoryOptions()
VALID = np.ones(SIZE, bool)
FLICKER = 0.3 * np.random.default_rng(2).standard_normal(14)


@pytest.fixture(scope="module")
def views() -> list[PlaneView]:
    whole = texture()
    return [plane_view(pose, whole) for pose in walk(14, step=0.15, turn=0.02)]


def played(
    views: list[PlaneView], errors: np.ndarray, state: ScaleMemoryState | None = None
) -> tuple[np.ndarray, ScaleMemoryState]:
    """Corrections of the frames' log depth, and the state after them."""
    state, found = state or ScaleMemoryState(), []
    for view, error in zip(views, errors, strict=True):
        depth = (view.depth * np.exp(error)).astype(np.float32)
        state, memory = step(state, view.image, depth, VALID, CAMERA, HOW)
        found.append(memory.correction)
    return np.array(found), state


def test_a_flicker_of_the_scale_is_taken_away(views: list[PlaneView]) -> None:
    corrections, _ = played(views, FLICKER)
    assert corrections[0] == 0
    assert np.std(FLICKER + corrections) < 0.35 * np.std(FLICKER)


def test_a_true_change_of_depth_is_not_an_error_of_scale() -> None:
    """The camera comes nearer all the time; the predictions are right."""
    whole = texture()
    views = [plane_view(pose_at((0, 0, 0.15 * i), (0, 0, 0)), whole) for i in range(8)]
    assert views[0].depth.mean() / views[-1].depth.mean() > 1.4
    corrections, _ = played(views, np.zeros(8))
    assert np.abs(corrections).max() < 0.02


def test_a_frame_alone_brings_its_own_scale_back(views: list[PlaneView]) -> None:
    """Pictures without structure: the correction that was is given up by and by."""
    corrections, state = played(views[:2], np.array([0.0, 0.4]))
    assert corrections[1] < -0.2
    bare = [PlaneView(np.full_like(v.image, 90), v.depth, v.pose) for v in views[2:6]]
    after, state = played(bare, np.full(4, 0.4), state)
    np.testing.assert_allclose(after, corrections[1] * HOW.hold ** np.arange(1, 5))
    again, _ = played(views[2:3], np.array([0.4]), state)  # what was seen before is still known
    assert again[0] < -0.15


def test_a_state_is_a_value_and_gives_the_same_bits_again(views: list[PlaneView]) -> None:
    _, state = played(views[:6], FLICKER[:6])
    count, kept = state.count, state.kept
    once, one = played(views[6:], FLICKER[6:], state)
    twice, other = played(views[6:], FLICKER[6:], state)
    np.testing.assert_array_equal(once, twice)
    assert (state.count, state.kept) == (count, kept) and one.count == other.count > count


def test_what_is_kept_reaches_back_and_stays_small(views: list[PlaneView]) -> None:
    state, how = ScaleMemoryState(), replace(HOW, most=60, shared=1.1)
    for view in [*views, *views[::-1]]:
        bare = np.where(np.arange(SIZE[1]) < SIZE[1] // 2, view.depth, np.nan)
        state, _ = step(state, view.image, bare, np.isfinite(bare), CAMERA, how)
    assert [number for number, _ in state.kept] == [27, 26, 24, 16]
    assert all((frame.key.points[:, 0] < 0.51).all() for _, frame in state.kept)


def test_a_camera_that_stands_still_keeps_its_first_picture(views: list[PlaneView]) -> None:
    corrections, state = played(views[:1] * 6, FLICKER[:6])
    assert state.count == 1 and state.last is not None
    assert np.std(FLICKER[:6] + corrections) < 0.35 * np.std(FLICKER[:6])
