"""What makes scores implausible is said, once and by its cause; what is right is not."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest

from dyfn_core.scoring.plausibility import EDGES_LOOKED_AT, Plausibility, Remedies
from tests.support.rectangles import MATRIX, SIZE, rectangles

COUNT = 12
Pair = tuple[np.ndarray, np.ndarray]
REMEDIES = Remedies("; UNIT", "; STAMPS", "; TRUTH", "; CAMERA", "; FAR")


def told(
    change: Callable[[int, Pair], tuple[np.ndarray, np.ndarray | None]] = lambda i, pair: pair,
    *,
    stamps: list[float] | None = None,
    matrix: np.ndarray | None = MATRIX,
    scored: int | None = COUNT,
    farthest: float = math.inf,
) -> list[str]:
    """The warnings of COUNT frames, each changed."""
    plausibility = Plausibility(COUNT, REMEDIES)
    for index in range(COUNT):
        image, truth = change(index, rectangles(index))
        stamp = index * 0.1 if stamps is None else stamps[index]
        plausibility.push(image, truth, stamp, matrix)
    return plausibility.warnings(scored, farthest)


def one(texts: list[str]) -> str:
    (text,) = texts
    return text


def test_of_right_frames_nothing_is_said() -> None:
    assert told() == []


@pytest.mark.parametrize("factor", [0.02, 1.0, 45.0])
def test_depth_of_5_cm_to_200_m_is_believed(factor: float) -> None:
    assert told(lambda i, pair: (pair[0], pair[1] * np.float32(factor))) == []


@pytest.mark.parametrize("factor", [1000.0, 80.0, 0.012])
def test_a_median_beyond_is_not(factor: float) -> None:
    text = one(told(lambda i, pair: (pair[0], pair[1] * np.float32(factor))))
    assert text.startswith("the median of the true depth is ") and text.endswith("; UNIT")
    assert ("millimetres read as metres?" in text) == (factor > 1)


def with_sky(value: Callable[[int, np.ndarray], float]) -> Callable[[int, Pair], Pair]:
    """The upper third has one value, made of the frame's number and its depth."""

    def change(index: int, pair: Pair) -> Pair:
        depth = pair[1].copy()
        depth[: SIZE[0] // 3] = value(index, depth)
        return pair[0], depth

    return change


def test_one_value_far_beyond_all_others_is_doubted() -> None:
    text = one(told(with_sky(lambda index, depth: 1000.0)))
    assert text.startswith("the true depth is 1000 m in many pixels of 12 frames")
    assert text.endswith("; FAR")


@pytest.mark.parametrize(
    ("value", "farthest"),
    [
        (lambda index, depth: 1000.0, 999.0),  # is not scored
        (lambda index, depth: 1000.0 + index, math.inf),  # is another in each frame
        (lambda index, depth: float(1.9 * depth.max()), math.inf),
    ],
)
def test_a_far_value_is_believed(
    value: Callable[[int, np.ndarray], float], farthest: float
) -> None:
    assert told(with_sky(value), farthest=farthest) == []


def test_the_median_is_over_frames_not_of_a_few_far_pixels() -> None:
    def far(index: int, pair: Pair) -> Pair:
        depth = pair[1].copy()
        depth[: SIZE[0] // 3] *= 1000
        return pair[0], depth

    assert told(far) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda i, p: rectangles(0), "all 12 pairs of picture and ground truth are equal"),
        (lambda i, p: (p[0], rectangles(0)[1]), "the ground truth is the same in all 12 frames"),
        (lambda i, p: (rectangles(0)[0], p[1]), "the picture is the same in all 12 frames"),
        (lambda i, p: (p[0], rectangles(i // 4)[1]), "the ground truth stands still: in 9 of 12"),
        (lambda i, p: (p[0], np.full(SIZE, 2.5, np.float32)), "one depth all over, in each of 12"),
        (lambda i, p: (p[0], np.full(SIZE, 2 + i, np.float32)), "one depth all over"),
        (lambda i, p: (p[0], rectangles(i + 90)[1]), "does not correlate with any picture"),
        (lambda i, p: (p[0], p[1][:, ::-1]), "does not correlate with any picture"),
        (lambda i, p: (p[0], p[1][::-1]), "does not correlate with any picture"),
        (lambda i, p: (p[0], np.roll(p[1], 20, 1)), "does not correlate with any picture"),
        (lambda i, p: (np.full_like(p[0], i), p[1]), "does not correlate with any picture"),
        (
            lambda i, p: (p[0], np.random.default_rng(i).uniform(1, 4, SIZE).astype(np.float32)),
            "does not correlate with any picture",
        ),
    ],
)
def test_truth_that_does_not_belong_to_the_pictures_is_named(
    change: Callable[[int, Pair], Pair], words: str
) -> None:
    assert words in one(told(change))


def test_every_second_truth_repeated_is_believed() -> None:
    """As of a depth sensor at half the camera's rate, of a scene that hardly moves."""
    assert told(lambda i, p: (np.maximum(rectangles(i // 2)[0], i), rectangles(i // 2)[1])) == []


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_truth_of_another_resolution_is_compared_all_the_same(scale: int) -> None:
    def smaller(index: int, pair: Pair) -> Pair:
        return pair[0], pair[1][::scale, ::scale]

    def flipped(index: int, pair: Pair) -> Pair:
        return pair[0], pair[1][::scale, ::-scale]

    assert told(smaller) == []
    assert "does not correlate" in one(told(flipped))


def test_truth_without_edges_says_nothing_of_the_pictures() -> None:
    slope = 2 + np.arange(SIZE[1], dtype=np.float32) / SIZE[1]

    def sloped(index: int, pair: Pair) -> Pair:
        return pair[0], np.broadcast_to(slope + index / 10, SIZE).copy()

    assert told(sloped) == []


def test_sparse_truth_is_looked_at_as_well() -> None:
    def sparse(index: int, pair: Pair) -> Pair:
        keep = np.random.default_rng(index).uniform(size=SIZE) < 0.3
        return pair[0], np.where(keep, pair[1] * 1000, np.nan).astype(np.float32)

    assert "millimetres" in one(told(sparse))


@pytest.mark.parametrize(("scored", "said"), [(12, False), (6, False), (5, True), (0, True)])
def test_fewer_than_half_of_the_frames_scored_is_said(scored: int, said: bool) -> None:
    texts = told(lambda i, p: (p[0], p[1] if i < scored else None), scored=scored)
    assert texts == (
        [
            f"{scored} of 12 frames are scored, less than half: the others have no ground truth "
            "or no depth, or too little of them in common"
        ]
        if said
        else []
    )


def test_without_truth_to_score_nothing_is_missed() -> None:
    assert told(lambda i, p: (p[0], None), scored=None) == []
    assert Plausibility(0).warnings(0) == []


@pytest.mark.parametrize(
    "pixels",
    [
        (1800, 1800, 959.5, 539.5),
        (80, 80, 95.6, 35.5),
        (80, 80, 47.5, -0.6),
        (0.9, 0.9, 0.5, 0.5),
        (2000, 2000, 47.5, 35.5),
    ],
)
def test_intrinsics_of_other_images_are_named(pixels: tuple[float, ...]) -> None:
    fx, fy, cx, cy = pixels
    text = one(told(matrix=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])))
    assert text.startswith(f"fx={fx:g} fy={fy:g} cx={cx:g} cy={cy:g} cannot be intrinsics")
    assert "of images of 96 x 72" in text and text.endswith("; CAMERA")


@pytest.mark.parametrize(
    ("pixels", "guess"),
    [
        ((40, 40, 23.5, 17.5), "of 48 x 36?"),
        ((160, 160, 88, 66), "of 177 x 133?"),
        ((80, 80, 35.5, 47.5), "of the image turned, 72 x 96?"),
        ((80, 80, 47.5, 10.0), "a cropped picture, or intrinsics of another?"),
    ],
)
def test_intrinsics_whose_principal_point_is_off_the_middle_are_doubted(
    pixels: tuple[float, ...], guess: str
) -> None:
    fx, fy, cx, cy = pixels
    text = one(told(matrix=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])))
    assert text.startswith(f"fx={fx:g} fy={fy:g} cx={cx:g} cy={cy:g} have the principal point")
    assert f"{guess}; CAMERA" in text


@pytest.mark.parametrize(("cx", "cy"), [(47.5, 35.5), (38, 42), (58, 29)])
def test_a_principal_point_near_the_middle_is_believed(cx: float, cy: float) -> None:
    assert told(matrix=np.array([[80, 0, cx], [0, 80, cy], [0, 0, 1.0]])) == []


def test_unknown_intrinsics_are_no_wrong_ones() -> None:
    assert told(matrix=None) == []


@pytest.mark.parametrize(
    ("stamps", "count"), [([0.0] * COUNT, 11), ([*range(6), *range(6)], 1), ([*range(11), 10], 1)]
)
def test_stamps_that_do_not_rise_are_counted(stamps: list[float], count: int) -> None:
    assert one(told(stamps=stamps)) == (
        f"stamps do not rise: {count} of 12 frames are not later than the one before; STAMPS"
    )


def test_each_reason_is_said_once_beside_the_others() -> None:
    texts = told(
        lambda i, p: (p[0], p[1][:, ::-1] * 1000 if i < 5 else None), stamps=[0.0] * 12, scored=5
    )
    assert [text.split()[0] for text in texts] == ["stamps", "5", "the", "the"]


def test_memory_does_not_grow_and_few_frames_are_compared() -> None:
    image, truth = rectangles(0)
    plausibility = Plausibility(4000)
    for index in range(200):
        plausibility.push(image, truth, index)
    tracemalloc.start()
    for index in range(200, 4000):
        plausibility.push(image, truth, index)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 4000 * 32
    assert 0 < plausibility._edges.frames <= EDGES_LOOKED_AT
