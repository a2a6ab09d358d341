"""Key points: found again after a motion, in a fixed order, matched without rounding."""

from __future__ import annotations

import cv2
import numpy as np

from dyfn_core.geometry.key_points import KeyPoints, find_key_points, matched
from tests.support.textured_plane import CAMERA, SIZE, plane_view, pose_at, texture


def test_matches_lie_on_the_same_place_of_the_scene() -> None:
    whole = texture()
    poses = pose_at((0, 0, 0), (0, 0, 0)), pose_at((0.3, 0, 0.2), (0, -0.05, 0.1))
    views = [plane_view(pose, whole) for pose in poses]
    keys = [find_key_points(view.image, 320, 400) for view in views]
    first, second = matched(*keys)
    assert len(first) > 60
    pixels = keys[0].points[first] * [SIZE[1], SIZE[0]] - 0.5
    columns, rows = np.rint(pixels).astype(int).T
    rays = np.column_stack([(pixels - CAMERA[:2, 2]) / 200.0, np.ones(len(pixels))])
    there = rays * views[0].depth[rows, columns, None] - poses[1][:3, 3]
    there = there @ poses[1][:3, :3]
    expected = there[:, :2] / there[:, 2:] * 200.0 + CAMERA[:2, 2]
    missed = np.linalg.norm(keys[1].points[second] * [SIZE[1], SIZE[0]] - 0.5 - expected, axis=1)
    assert (missed < 2).mean() > 0.9


def test_products_of_descriptors_are_exact_in_float32() -> None:
    """Whatever the order of the sums, and so however many threads there are."""
    key = find_key_points(plane_view(pose_at((0, 0, 0), (0, 0, 0)), texture()).image, 320, 400)
    whole = key.descriptors.astype(np.int64)
    assert (whole @ whole.T).max() < 2**24
    single = key.descriptors.astype(np.float32)
    np.testing.assert_array_equal(single @ single.T, whole @ whole.T)


def test_a_large_picture_is_shrunk_and_places_are_shares_of_it() -> None:
    image = plane_view(pose_at((0, 0, 0), (0, 0, 0)), texture()).image
    large = cv2.resize(image, (4 * SIZE[1], 4 * SIZE[0]), interpolation=cv2.INTER_CUBIC)
    keys = [find_key_points(picture, SIZE[1], 300) for picture in (image, large)]
    first, second = matched(*keys)
    assert len(first) > 100
    apart = np.linalg.norm(keys[0].points[first] - keys[1].points[second], axis=1)
    assert np.median(apart) < 0.005


def test_nothing_is_found_in_an_empty_picture_nor_matched_with_it() -> None:
    nothing = find_key_points(np.full((60, 80, 3), 90, np.uint8), 320, 100)
    assert nothing.points.shape == (0, 2) and nothing.descriptors.shape == (0, 128)
    assert all(len(part) == 0 for part in matched(nothing, nothing))


def test_a_key_point_with_two_equal_candidates_is_not_matched() -> None:
    one = np.zeros((2, 128), np.uint8)
    one[0, 0] = one[1, 1] = 200
    twice = np.repeat(one[:1], 2, axis=0)
    places = np.zeros((2, 2), np.float32)
    first, _ = matched(KeyPoints(places, one), KeyPoints(places, twice))
    assert len(first) == 0
