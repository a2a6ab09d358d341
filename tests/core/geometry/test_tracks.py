"""Tracks against a picture that is moved by a known amount."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dyfn_core.geometry.tracks import TrackOptions, track
from tests.support.textured_plane import texture

WHOLE = texture()
OPTIONS = TrackOptions(most=200)


def shifted(dx: float, dy: float, size: tuple[int, int] = (180, 240)) -> np.ndarray:
    """The picture whose content has moved by (dx, dy) pixels."""
    matrix = np.array([[1.0, 0, dx - 300], [0, 1.0, dy - 300]])
    grey = cv2.warpAffine(WHOLE, matrix, size[::-1])
    return np.repeat(grey[..., None], 3, axis=2)


@pytest.mark.parametrize("move", [(2.0, -1.0), (7.5, 3.25)])
def test_points_follow_the_picture(move: tuple[float, float]) -> None:
    first = track(None, shifted(0, 0), OPTIONS)
    second = track(first, shifted(*move), OPTIONS)
    both, before, after = np.intersect1d(first.tracks.ids, second.tracks.ids, return_indices=True)
    assert len(both) > 150
    moved = second.tracks.points[after] - first.tracks.points[before]
    assert np.abs(np.median(moved, axis=0) - move).max() < 0.02
    assert np.quantile(np.abs(moved - move), 0.95) < 0.1  # Lucas-Kanade's usual precision


def test_points_of_a_large_picture_are_in_its_own_pixels() -> None:
    size = (360, 480)
    options = TrackOptions(most=200, long_side=240)
    first = track(None, shifted(0, 0, size), options)
    second = track(first, shifted(10, 6, size), options)
    _, before, after = np.intersect1d(first.tracks.ids, second.tracks.ids, return_indices=True)
    moved = second.tracks.points[after] - first.tracks.points[before]
    assert first.grey.shape == (180, 240)
    assert np.abs(np.median(moved, axis=0) - [10, 6]).max() < 0.05
    assert first.tracks.points[:, 0].max() > 300


def test_turn_is_followed_only_with_the_first_guess() -> None:
    far = (90.0, 0.0)  # beyond what the pyramid can search
    homography = np.array([[1.0, 0, far[0]], [0, 1, far[1]], [0, 0, 1]])
    first = track(None, shifted(0, 0), OPTIONS)
    old = first.tracks.ids
    blind = track(first, shifted(*far), OPTIONS)
    guided = track(first, shifted(*far), OPTIONS, homography)
    moved = guided.tracks.ids[np.isin(guided.tracks.ids, old)]
    places = guided.tracks.points[np.isin(guided.tracks.ids, old)]
    error = places - first.tracks.points[np.isin(old, moved)] - far
    assert len(moved) > 80
    assert np.abs(np.median(error, axis=0)).max() < 0.05
    assert np.isin(blind.tracks.ids, old).sum() < 0.5 * len(moved)


def test_another_size_ends_all_tracks_and_their_numbers_are_not_used_again() -> None:
    first = track(None, shifted(0, 0), OPTIONS)
    second = track(first, shifted(0, 0, (120, 160)), OPTIONS)
    assert second.tracks.ids.min() == first.next_id


def test_corners_keep_their_distance_and_number() -> None:
    found = track(None, shifted(0, 0), TrackOptions(most=60, spacing=9.0)).tracks.points
    distance = np.linalg.norm(found[:, None] - found, axis=2) + 1e9 * np.eye(len(found))
    assert 30 < len(found) <= 60
    assert distance.min() >= 9.0


def test_blank_picture_ends_tracks_without_an_error() -> None:
    blank = np.full((180, 240, 3), 128, np.uint8)
    first = track(None, shifted(0, 0), OPTIONS)
    second = track(first, blank, OPTIONS)
    third = track(second, blank, OPTIONS)
    assert len(third.tracks.ids) < 0.1 * len(first.tracks.ids)
    assert len(track(None, blank, OPTIONS).tracks.ids) == 0


def test_same_pictures_give_the_same_bytes_and_leave_the_state_alone() -> None:
    first = track(None, shifted(0, 0), OPTIONS)
    kept = first.grey.tobytes(), first.tracks.points.tobytes(), first.tracks.ids.tobytes()
    one, two = (track(first, shifted(3, 1), OPTIONS).tracks for _ in range(2))
    assert one.points.tobytes() == two.points.tobytes()
    assert one.ids.tobytes() == two.ids.tobytes()
    assert kept == (first.grey.tobytes(), first.tracks.points.tobytes(), first.tracks.ids.tobytes())
