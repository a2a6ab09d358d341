"""Images and depth whose stamps do not tell them apart: never a wrong pair."""

from pathlib import Path
from typing import Any

import numpy as np
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
                image_of(index, image_stamps[index])
                if topic == "/image"
                else depth_of(index, depth_stamps[index])
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


def shifted(seconds: float, stamps: list[int] = EXACT) -> list[int]:
    return [2 * SECOND + stamp + round(seconds * SECOND) for stamp in stamps]


@pytest.mark.parametrize(
    ("offset", "told"),
    [
        (0.04, "0.04 s after"),  # less than half a period, and no image has depth
        (-0.04, "0.04 s before"),
        (0.35, "0.35 s after"),  # the nearest depths are 0.05 s away
        (-0.35, "0.35 s before"),
        (0.1, "0.1 s after"),  # each image has the depth of another one
        (-0.1, "0.1 s before"),
        (3.51, "3.51 s after"),
        (1.7e9, "1700000000 s after"),  # time since start against time since 1970
    ],
)
@pytest.mark.parametrize("depth_first", [False, True])
def test_a_constant_offset_is_named_and_mended_by_the_option(
    tmp_path: Path, offset: float, told: str, depth_first: bool
) -> None:
    write(tmp_path / "bag", shifted(0), shifted(offset), depth_first=depth_first)
    recording = open_recording(tmp_path / "bag")
    found = numbers(recording.frames())
    assert [i for i, n in enumerate(found) if i == n] == []
    (text,) = recording.doubts()
    assert text.startswith(f"/depth: its stamps are {told} those of ")
    named = float(text.partition("--depth-offset ")[2].split()[0])
    assert named == offset and "--stamps log" in text

    mended = open_recording(tmp_path / "bag", depth_offset=named)
    assert numbers(mended.frames()) == [*range(COUNT)] and mended.doubts() == []
    by_log = open_recording(tmp_path / "bag", stamps="log")
    assert numbers(by_log.frames()) == [*range(COUNT)] and by_log.doubts() == []
    wrong = open_recording(tmp_path / "bag", depth_offset=named + 0.2)
    assert numbers(wrong.frames()) != [*range(COUNT)]
    (text,) = wrong.doubts()
    assert f"less --depth-offset {named + 0.2:g}, are 0.2 s before" in text
    assert f"--depth-offset {told.split()[0] if offset > 0 else offset:} takes" in text


@pytest.mark.parametrize(
    ("factor", "first", "last"), [(1.25, "0.025", "0.25"), (1.05, "0.005", "0.05")]
)
def test_a_clock_that_drifts_is_named(tmp_path: Path, factor: float, first: str, last: str) -> None:
    drifting = [2 * SECOND + round(factor * stamp) for stamp in EXACT]
    write(tmp_path / "bag", shifted(0), drifting)
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) != [*range(COUNT)]
    (text,) = recording.doubts()
    assert text == (
        f"/depth: its stamps are {first} s after those of the images recorded with them at first "
        f"and {last} s after at last: one clock drifts; --stamps log takes the time of recording"
    )
    by_log = open_recording(tmp_path / "bag", stamps="log")
    assert numbers(by_log.frames()) == [*range(COUNT)] and by_log.doubts() == []


@pytest.mark.parametrize("late", [1, -1])
def test_depth_that_is_recorded_late_with_the_stamps_of_its_images_is_right(
    tmp_path: Path, late: int
) -> None:
    """Its delay is more than a period; the stamps, which are not regular, belong together."""
    uneven = [
        2 * SECOND + stamp + int(noise)
        for stamp, noise in zip(
            EXACT, np.random.default_rng(1).integers(0, 1_000_000, COUNT), strict=True
        )
    ]
    with RecordingWriter(tmp_path / "bag") as writer:
        put = [("/image", image_of, 0.01), ("/depth", depth_of, 0.01 + late * 0.12)]
        for topic, maker, delay in put:
            for index, at in enumerate(uneven):
                writer.write(topic, IMAGE, maker(index, at), at + round(delay * SECOND))
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) == [*range(COUNT)]
    assert recording.doubts() == [] and not recording.notes.warnings


def image_of(index: int, at: int) -> Any:
    return image_message(picture(index), "rgb8", at, "camera")


def depth_of(index: int, at: int) -> Any:
    return image_message(depth(index), "32FC1", at, "camera")


FAR = 40  # more than wait for each other in the order of recording


@pytest.mark.parametrize("order", ["images first", "depths first", "late depths", "early depths"])
def test_images_and_depths_of_one_stamp_may_be_anywhere_in_the_file(
    tmp_path: Path, order: str
) -> None:
    late = {"late depths": 35, "early depths": -35}.get(order, 1000)
    late = -late if order == "depths first" else late
    with RecordingWriter(tmp_path / "bag") as writer:
        for index in range(FAR):
            at = SECOND + index * STEP
            for topic, message, place in (
                ("/image", image_of(index, at), index),
                ("/depth", depth_of(index, at), index + late),
            ):
                writer.write(topic, IMAGE, message, SECOND + 1_000_000 * place)
    recording = open_recording(tmp_path / "bag")
    for _ in range(2):
        assert numbers(recording.frames()) == [*range(FAR)]
        assert not recording.notes.warnings and not recording.notes.losses
    assert recording.topics.depth == "/depth"


def test_equal_stamps_far_apart_in_the_file_score_nothing(tmp_path: Path) -> None:
    """Images 3 and 4 have one stamp, and so have depths 7 and 8, and 9 is there twice."""
    with RecordingWriter(tmp_path / "bag") as writer:
        for index in range(FAR):
            at = SECOND + (index - (index == 4)) * STEP
            writer.write("/image", IMAGE, image_of(index, at), SECOND + index)
        for index in range(FAR):
            at = SECOND + (index - (index == 8)) * STEP
            for _ in range(1 + (index == 9)):
                writer.write("/depth", IMAGE, depth_of(index, at), 2 * SECOND + index)
    recording = open_recording(tmp_path / "bag")
    expected = [None if index in (3, 4, 7, 8) else index for index in range(FAR)]
    assert numbers(recording.frames()) == expected
    assert recording.notes.warnings[AMBIGUOUS] == 3
    assert recording.notes.warnings["/depth: no depth at an image's stamp"] == 1
    assert recording.doubts() == []


def test_images_that_were_recorded_in_reverse_have_their_depth(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for place, index in enumerate(reversed(range(FAR))):
            at = SECOND + index * STEP
            writer.write("/image", IMAGE, image_of(index, at), SECOND + place)
            writer.write("/depth", IMAGE, depth_of(index, at), SECOND + place)
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) == [*reversed(range(FAR))]
