"""Covered lenses, flashes, frozen cameras: no depth and no metres, and at once depth afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dyfn_core.metric.references import PointReference
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.picture_check import BLANK, CONTRAST, FROZEN, contrast
from dyfn_core.stream.session import StreamSession
from tests.core.stream.test_scene_cut import scene, seen
from tests.support.tiny_model import load_tiny

SIZE = (240, 320)
DOWN, ACROSS = np.mgrid[-1 : 1 : SIZE[0] * 1j, -1 : 1 : SIZE[1] * 1j]


def noise(mean: float, loud: float, size: tuple[int, int] = (480, 640)) -> np.ndarray:
    return np.random.default_rng(1).normal(mean, loud, size)


def dated() -> np.ndarray:
    picture = np.zeros((480, 640), np.uint8)
    cv2.putText(picture, "2026-11-30 05:00:00", (10, 30), 0, 1, (255,), 2)
    return picture


NOTHING = {
    "black": np.zeros(SIZE),
    "white": np.full(SIZE, 255.0),
    "grey": np.full(SIZE, 128.0),
    "vignette": 220 - 120 * (DOWN**2 + ACROSS**2),
    "brightness across": 127 + 127 * ACROSS,
    "light past a cover": 200 * np.exp(-((ACROSS - 1) ** 2 + (DOWN + 0.6) ** 2) * 1.3),
    "noise in the dark": noise(10, 20),
    "noise in the dark, 320x240": noise(10, 20, SIZE),
    "loud noise": noise(100, 60),
    "noise of rows": 10 + noise(0, 3) + noise(0, 3, (480, 1)),
    "black with the date": dated(),
}


@pytest.mark.parametrize("name", NOTHING)
def test_what_shows_no_scene_has_no_contrast(name: str) -> None:
    grey = np.clip(NOTHING[name], 0, 255).astype(np.uint8)
    assert contrast(np.repeat(grey[..., None], 3, axis=2)) < CONTRAST


@pytest.mark.parametrize("gain", [0.2, 0.5, 1.0])
def test_pictures_of_scenes_have_contrast_also_dim_noisy_or_blurred(gain: float) -> None:
    for seed in range(5):
        picture = gain * seen(scene(seed), 0).astype(float)
        picture = cv2.GaussianBlur(picture, (0, 0), 6) + noise(2, 4, (*picture.shape[:2], 1))
        assert contrast(np.clip(picture, 0, 255).astype(np.uint8)) > CONTRAST


def test_photographs_have_contrast(shared_dir: Path) -> None:
    files = sorted((shared_dir / "data/real").glob("*/rgb/*.jpg"))[::20]
    assert files
    for path in files:
        assert contrast(cv2.imread(str(path))[..., ::-1].copy()) > 2 * CONTRAST, path


@pytest.mark.parametrize("size", [(1, 1), (1, 640), (640, 1), (8, 8), (7, 3)])
def test_any_size_will_do(size: tuple[int, int]) -> None:
    assert contrast(np.full((*size, 3), 7, np.uint8)) == pytest.approx(0, abs=1e-6)


def session_of(**options: Any) -> StreamSession:
    return StreamSession(load_tiny(), StreamOptions(scene_cut_threshold=0.0, **options))


def walk(count: int) -> list[np.ndarray]:
    panorama = cv2.resize(scene(2), (240, 60))
    return [np.ascontiguousarray(panorama[:, i : i + 80]) for i in range(count)]


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_cover_takes_depth_and_metres_away_while_it_lasts(level: int) -> None:
    session = session_of(metric_source="fixed", metric_scale=2.0)
    pictures = walk(9)
    pictures[3:6] = [np.full_like(pictures[0], level)] * 3
    for index, picture in enumerate(pictures):
        found = session.push(picture, index / 10)
        covered = 3 <= index < 6
        assert found.valid.any() != covered
        assert session.faults() == ([BLANK] if covered else [])
    assert session.unusable_pictures == {BLANK: 3}
    assert session.report()["picture"] == "shows a scene"
    assert session.report()[f"pictures without depth, {BLANK}"] == "3"
    assert not session.resets


def test_nothing_is_measured_by_a_covered_lens() -> None:
    session = session_of(metric_source="reference", calibration_seconds=0.2)
    black, relative = np.zeros((60, 80, 3), np.uint8), session_of()
    for index, picture in enumerate([black] * 6 + walk(6)):
        seen_by = relative.push(picture, index / 10)
        rows, columns = np.nonzero(seen_by.mask | (index < 6))
        points = 3.0 * seen_by.points[rows[::40], columns[::40]]
        session.add_reference(index / 10, PointReference(points))
        found = session.push(picture, index / 10)
        assert found.metric == (index > 7)


def test_a_frozen_camera_is_told_after_its_time_and_thaws_at_once() -> None:
    session, pictures = session_of(frozen_after=1.0), walk(2)
    found = [session.push(pictures[0], index / 10).valid.any() for index in range(15)]
    assert found == [index < 10 for index in range(15)]
    assert session.faults() == [FROZEN]
    assert session.unusable_pictures == {FROZEN: 5}
    assert session.push(pictures[1], 1.5).valid.any()
    assert not session.faults()


def test_one_pixel_that_differs_is_no_frozen_camera() -> None:
    session, picture = session_of(), walk(1)[0]
    for index in range(20):
        picture[3, 5] = index  # the caller's own buffer, filled again and again
        assert session.push(picture, index / 10).valid.any()


def test_few_pictures_are_not_enough_however_long_they_take() -> None:
    session, picture = session_of(), walk(1)[0]
    assert all(session.push(picture, float(index)).valid.any() for index in range(9))
    assert not session.push(picture, 9.0).valid.any()


def test_a_camera_that_moves_cannot_see_the_same() -> None:
    session, picture = session_of(), walk(1)[0]
    found = []
    for index in range(5):
        pose = np.eye(4)
        pose[2, 3] = 0.03 * index
        found.append(session.push(picture, index / 10, pose=pose).valid.any())
    assert found == [True, True, False, False, False]


def test_a_reset_forgets_the_frozen_picture() -> None:
    session, picture = session_of(frozen_after=0.5), walk(1)[0]
    first = [session.push(picture, index / 10).valid.any() for index in range(12)]
    session.request_reset()
    second = [session.push(picture, 2 + index / 10).valid.any() for index in range(12)]
    assert first == second == [index < 9 for index in range(12)]


def test_both_checks_can_be_switched_off() -> None:
    session = session_of(blank_contrast=0.0, frozen_after=0.0)
    black = np.zeros((60, 80, 3), np.uint8)
    assert all(session.push(black, index / 10).valid.any() for index in range(30))
    assert not session.unusable_pictures
