"""Images and depth whose stamps do not tell them apart: never a wrong pair."""

from pathlib import Path

import pytest

from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.typestore import IMAGE, image_message
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.numbered import SECOND, depth, numbers, picture

COUNT = 12
STEP = SECOND // 10
AMBIGUOUS = (
    "/depth: no depth at an image's stamp is used where several images or depths have that stamp: "
    "nothing tells which belong together (--stamps log takes the time of recording)"
)


def write(
    path: Path,
    image_stamps: list[int],
    depth_stamps: list[int],
    *,
    depth_first: bool = False,
    missing: int | None = None,
    twice: int | None = None,
) -> Path:
    """Image and depth i are logged at the time i / 10 s, whatever their headers say.

    missing: number of a depth that is left out. twice: number of a frame written two times.
    """
    with RecordingWriter(path) as writer:

        def put(topic: str, index: int, log_ns: int) -> None:
            image = (
                image_message(picture(index), "rgb8", image_stamps[index], "camera")
                if topic == "/image"
                else image_message(depth(index), "32FC1", depth_stamps[index], "camera")
            )
            if topic == "/image" or index != missing:
                writer.write(topic, IMAGE, image, log_ns)

        for index in range(len(image_stamps)):
            for topic in ("/depth", "/image") if depth_first else ("/image", "/depth"):
                put(topic, index, SECOND + index * STEP)
                if index == twice:
                    put(topic, index, SECOND + index * STEP)
    return path


ZERO = [0] * COUNT
EXACT = [index * STEP for index in range(COUNT)]
WHOLE = [stamp // SECOND * SECOND for stamp in EXACT]
IN_TWOS = [index // 2 * STEP for index in range(COUNT)]
ONE_TWICE = [stamp - STEP * (index == 5) for index, stamp in enumerate(EXACT)]


@pytest.mark.parametrize("depth_first", [False, True])
@pytest.mark.parametrize("missing", [None, 3])
@pytest.mark.parametrize(
    ("image_stamps", "depth_stamps"),
    [(ZERO, ZERO), (WHOLE, WHOLE), (IN_TWOS, IN_TWOS), (ZERO, EXACT), (WHOLE, EXACT)],
    ids=["zero", "whole seconds", "in twos", "images zero", "images whole seconds"],
)
def test_stamps_that_tell_nothing_apart_score_nothing(
    tmp_path: Path,
    image_stamps: list[int],
    depth_stamps: list[int],
    depth_first: bool,
    missing: int | None,
) -> None:
    write(tmp_path / "bag", image_stamps, depth_stamps, depth_first=depth_first, missing=missing)
    recording = open_recording(tmp_path / "bag")
    found = numbers(recording.frames())
    wrong = [(i, n) for i, n in enumerate(found) if n not in (None, i)]
    assert len(found) == COUNT and not wrong
    assert found.count(None) >= COUNT - 2
    assert recording.notes.warnings[AMBIGUOUS] >= COUNT - 4

    recording = open_recording(tmp_path / "bag", stamps="log")
    expected = [None if index == missing else index for index in range(COUNT)]
    assert numbers(recording.frames()) == expected
    assert AMBIGUOUS not in recording.notes.warnings


@pytest.mark.parametrize("depth_first", [False, True])
def test_one_stamp_twice_costs_those_frames_only(tmp_path: Path, depth_first: bool) -> None:
    write(tmp_path / "bag", ONE_TWICE, ONE_TWICE, depth_first=depth_first)
    recording = open_recording(tmp_path / "bag")
    expected = [None if index in (4, 5) else index for index in range(COUNT)]
    assert numbers(recording.frames()) == expected
    assert recording.notes.warnings[AMBIGUOUS] == 2


def test_depth_of_whole_seconds_is_not_taken_for_fine_images(tmp_path: Path) -> None:
    write(tmp_path / "bag", EXACT, WHOLE)
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) == [None] * COUNT
    assert recording.notes.warnings[AMBIGUOUS] == 2  # at 0 s and at 1 s


@pytest.mark.parametrize("depth_first", [False, True])
def test_the_same_message_twice_is_one(tmp_path: Path, depth_first: bool) -> None:
    write(tmp_path / "bag", EXACT, EXACT, depth_first=depth_first, twice=4)
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) == [0, 1, 2, 3, 4, 4, *range(5, COUNT)]
    assert AMBIGUOUS not in recording.notes.warnings


@pytest.mark.parametrize(("part", "words"), [(0.4, "after"), (-0.4, "before")])
def test_a_constant_offset_is_named(tmp_path: Path, part: float, words: str) -> None:
    shifted = [SECOND + stamp + round(part * STEP) for stamp in EXACT]
    write(tmp_path / "bag", [SECOND + stamp for stamp in EXACT], shifted)
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) == [None] * COUNT
    (text,) = (text for text in recording.notes.warnings if "nearest" in text)
    assert f"0.040 s {words} the image (median), beyond --tolerance 0.02;" in text
    assert "--stamps log" in text
    assert numbers(open_recording(tmp_path / "bag", stamps="log").frames()) == [*range(COUNT)]
