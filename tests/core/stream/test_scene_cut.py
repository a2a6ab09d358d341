"""Scene cuts: found at once and once, and not where the camera only turns, blinks or is covered."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from dyfn_core.prediction import Frame
from dyfn_core.stream.resets import SCENE_CUT
from dyfn_core.stream.scene_cut import (
    SceneCutDetector,
    leniency,
    picture_features,
    scene_difference,
)
from dyfn_core.stream.session import StreamSession
from tests.support.tiny_model import load_tiny


def scene(seed: int, width: int = 480, height: int = 240) -> np.ndarray:
    """A wide picture of random coloured boxes."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width, 3), rng.integers(60, 200, 3), np.uint8)
    for _ in range(60):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        size = rng.integers(15, 90, 2)
        colour = tuple(int(c) for c in rng.integers(0, 256, 3))
        cv2.rectangle(image, (x, y), (x + int(size[0]), y + int(size[1])), colour, -1)
    return image


def seen(panorama: np.ndarray, left: int, width: int = 320) -> np.ndarray:
    return np.ascontiguousarray(panorama[:, left : left + width])


def test_a_cut_is_found_at_its_first_frame_and_reported_once() -> None:
    detector = SceneCutDetector()
    cuts = [detector.push(seen(scene(0), left)) for left in range(0, 40, 10)]
    cuts += [detector.push(seen(scene(1), left)) for left in range(0, 40, 10)]
    assert cuts == [False] * 4 + [True] + [False] * 3


def test_every_other_made_cut_is_found() -> None:
    for seed in range(20):
        detector = SceneCutDetector()
        detector.push(seen(scene(seed), 0))
        assert detector.push(seen(scene(seed + 100), 0)), seed


@pytest.mark.parametrize("step", [20, 60, 100])
def test_a_fast_turn_is_no_cut(step: int) -> None:
    """Up to a third of the picture from one frame to the next, and blurred by it."""
    for seed in range(5):
        panorama = cv2.blur(scene(seed, 640), (1 + step // 6, 1))
        detector = SceneCutDetector()
        assert not any(detector.push(seen(panorama, left)) for left in range(0, 320, step)), seed


@pytest.mark.parametrize("gain", [0.35, 0.6, 1.6, 2.2])
def test_an_exposure_jump_is_no_cut(gain: float) -> None:
    picture = seen(scene(3), 0)
    brighter = np.clip(gain * picture.astype(float), 0, 255).astype(np.uint8)
    detector = SceneCutDetector()
    assert not any(detector.push(image) for image in (picture, brighter, picture))


def test_something_in_front_of_the_camera_is_no_cut() -> None:
    picture, covered = seen(scene(4), 0), seen(scene(4), 10)
    covered[:, :130] = seen(scene(9), 0)[:, :130]
    detector = SceneCutDetector()
    assert not any(detector.push(image) for image in (picture, covered, picture))


@pytest.mark.parametrize("level", [0, 128, 255])
def test_a_flash_or_a_cover_is_no_cut_but_a_new_scene_behind_it_is(level: int) -> None:
    blank = np.full((240, 320, 3), level, np.uint8)
    detector = SceneCutDetector()
    same = [seen(scene(5), 0), blank, blank, seen(scene(5), 10)]
    assert not any(detector.push(image) for image in same)
    assert [detector.push(image) for image in (blank, seen(scene(6), 0))] == [False, True]


def test_after_a_long_blank_the_next_picture_is_a_first_one() -> None:
    detector = SceneCutDetector()
    detector.push(seen(scene(5), 0))
    for _ in range(10):
        detector.push(np.zeros((240, 320, 3), np.uint8))
    assert not detector.push(seen(scene(6), 0))


def test_a_slide_show_is_one_cut_until_pictures_are_alike_again() -> None:
    detector = SceneCutDetector()
    shown = [seen(scene(seed), 0) for seed in range(6)]
    assert [detector.push(image) for image in shown] == [False, True, *[False] * 4]
    assert not detector.push(seen(scene(5), 10))
    assert detector.push(seen(scene(0), 0))


def test_the_difference_is_causal_bounded_and_zero_for_the_same_picture() -> None:
    one, other = picture_features(seen(scene(0), 0)), picture_features(seen(scene(1), 0))
    assert scene_difference(one, one) == pytest.approx(0, abs=1e-3)
    assert 0.5 < scene_difference(one, other) <= 1.5


@pytest.mark.parametrize("size", [(8, 8), (24, 32), (37, 1000), (1080, 1920)])
def test_any_size_of_picture_will_do(size: tuple[int, int]) -> None:
    picture = cv2.resize(scene(0), (size[1], size[0]))
    detector = SceneCutDetector()
    assert not detector.push(picture)
    assert not detector.push(picture)


def test_a_remembered_state_goes_on_alike() -> None:
    one, other = SceneCutDetector(), SceneCutDetector()
    one.push(seen(scene(0), 0))
    other.state = one.state
    for image in (seen(scene(0), 20), seen(scene(1), 0), seen(scene(1), 20)):
        assert one.push(image) == other.push(image)
        assert one.difference == other.difference


def test_the_longer_ago_the_last_picture_the_more_may_have_changed() -> None:
    before, now = seen(scene(3), 0), seen(scene(4), 0)
    cuts = []
    for seconds in (0.1, 0.2, 0.4, 0.6, 2.0):
        detector = SceneCutDetector()
        detector.push(before, 10.0)
        cuts.append(detector.push(now, 10.0 + seconds))
        assert detector.allowed == pytest.approx(0.6 * leniency(seconds))
    assert cuts[:2] == [True, True]
    assert not cuts[-1]
    assert cuts == sorted(cuts, reverse=True)


@pytest.mark.parametrize(
    ("degrees", "metres", "cut"), [(2, 0.02, True), (60, 0.0, False), (0, 1.0, False)]
)
def test_a_pose_says_whether_the_time_was_used_to_move(
    degrees: float, metres: float, cut: bool
) -> None:
    """A second later: a camera at rest sees another scene only after a cut."""
    detector, pose = SceneCutDetector(), np.eye(4)
    turn = np.radians(degrees)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.0, turn, 0.0]))[0]
    pose[2, 3] = metres
    detector.push(seen(scene(3), 0), 10.0)
    detector.locate(10.0, np.eye(4))
    assert detector.push(seen(scene(4), 0), 11.0, lambda: pose) is cut


def test_a_pose_is_asked_for_only_where_it_decides() -> None:
    def unwanted() -> np.ndarray:
        raise AssertionError("asked for")

    detector = SceneCutDetector()
    for stamp, picture in ((10.0, scene(3)), (11.0, scene(3)), (11.1, scene(4))):
        detector.push(seen(picture, 0), stamp, unwanted)
        detector.locate(stamp, np.eye(4))


def test_pictures_that_are_skipped_tell_a_cut_from_a_walk() -> None:
    """Ten pictures a second of which every tenth is worked on."""

    def resets(pictures: list[np.ndarray], skip: bool) -> dict[str, int]:
        session = StreamSession(load_tiny())
        for index, picture in enumerate(pictures):
            frame = Frame(cv2.resize(picture, (96, 72)), index / 10)
            if index % 10 == 0:
                session.push(frame)
            elif skip:
                session.skip(frame)
        return dict(session.resets)

    panorama = scene(5, 2400)
    walk = [seen(panorama, 40 * index) for index in range(41)]
    cut = [seen(scene(6 + index // 25), 2 * (index % 25)) for index in range(41)]
    assert resets(walk, True) == resets(walk, False) == {}
    assert resets(cut, True) == {SCENE_CUT: 1}


def test_a_reset_is_told_with_its_time_reason_and_measure() -> None:
    session = StreamSession(load_tiny())
    for index, seed in enumerate((3, 3, 4)):
        session.push(cv2.resize(seen(scene(seed), 0), (96, 72)), index / 10)
    assert re.fullmatch(r"at 0\.200 s: scene cut \(difference .* of 0\.600\)", session.last_reset)
    session.request_reset()
    session.push(cv2.resize(seen(scene(4), 0), (96, 72)), 0.3)
    assert session.last_reset == "at 0.300 s: requested"


def test_without_stamps_pictures_are_taken_for_consecutive() -> None:
    detector = SceneCutDetector()
    detector.push(seen(scene(3), 0), 10.0)
    assert detector.push(seen(scene(4), 0))
    assert detector.allowed == detector.threshold


@pytest.mark.parametrize("options", [{"threshold": 0.0}, {"threshold": 3.0}, {"release": 0.0}])
def test_bad_options_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be in"):
        SceneCutDetector(**options)
