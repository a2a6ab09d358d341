"""Predictions from files: every format, quantity and way of matching them to frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.predictions import ArrayMethod, PredictionFolder
from dyfn_core.evaluation.benchmarks.registry import BenchmarkFrame, BenchmarkSequence
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkSource

SIZE = (6, 8)
ALL = [depth.astype(np.float32) for depth in np.random.default_rng(0).uniform(1, 5, (6, *SIZE))]


def sequence(numbers: tuple[int, ...] = (11, 13, 15)) -> BenchmarkSequence:
    """Frames 11, 13, 15 of the six frames 10..15."""
    source = BenchmarkSource("room/one", range(10, 16), lambda chosen: iter(()))
    return BenchmarkSequence("room/one", numbers, 6, source)


def scored(folder: PredictionFolder) -> np.ndarray:
    return np.stack(list(folder.arrays(sequence())))


def write(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, values)
    elif path.suffix == ".npz":
        np.savez_compressed(path, depth=values)
    elif path.suffix == ".png":
        assert cv2.imwrite(str(path), np.round(values * 1000).astype(np.uint16))
    else:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": values}).write(str(path))


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".png", ".exr"])
def test_one_file_a_frame_is_found_by_number(tmp_path: Path, suffix: str) -> None:
    for number, values in enumerate(ALL, start=10):
        write(tmp_path / "room" / "one" / f"frame_{number:04}{suffix}", values)
    folder = PredictionFolder(tmp_path, 1000 if suffix == ".png" else None)
    np.testing.assert_allclose(scored(folder), np.stack(ALL[1::2]), atol=6e-4)


@pytest.mark.parametrize("suffix", [".npz", ".npy"])
@pytest.mark.parametrize("layout", ["thw", "t1hw", "scored"])
def test_one_file_a_sequence(tmp_path: Path, suffix: str, layout: str) -> None:
    stacked = np.stack(ALL)
    values = {"thw": stacked, "t1hw": stacked[:, None], "scored": stacked[1::2]}[layout]
    write(tmp_path / f"room_one{suffix}", values)
    np.testing.assert_array_equal(scored(PredictionFolder(tmp_path)), stacked[1::2])


def test_files_with_other_numbers_are_taken_in_numeric_order(tmp_path: Path) -> None:
    for place, values in zip((98, 99, 100), ALL, strict=False):
        write(tmp_path / "room" / "one" / f"{place}.npy", values)
    np.testing.assert_array_equal(scored(PredictionFolder(tmp_path)), np.stack(ALL[:3]))


def test_a_png_needs_a_scale_and_its_zero_says_nothing(tmp_path: Path) -> None:
    values = ALL[0].copy()
    values[0, 0] = 0
    for number in (11, 13, 15):
        write(tmp_path / "room" / "one" / f"{number}.png", values)
    with pytest.raises(DataError, match=r"11\.png: 16-bit PNG needs a scale"):
        scored(PredictionFolder(tmp_path))
    found = scored(PredictionFolder(tmp_path, 1000.0))
    assert np.isnan(found[:, 0, 0]).all() and np.isfinite(found).sum() == 3 * (48 - 1)
    with pytest.raises(DataError, match="scale must be positive"):
        scored(PredictionFolder(tmp_path, 0.0))


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no predictions of room/one: expected room/one\.npz"):
        scored(PredictionFolder(tmp_path))
    path = tmp_path / "room_one.npz"
    write(path, np.stack(ALL[:4]))
    with pytest.raises(DataError, match=r"4 predictions for room/one, expected 3 .* or 6"):
        scored(PredictionFolder(tmp_path))
    np.savez(path, a=np.ones(3), b=np.ones(3))
    with pytest.raises(FrameError, match=r"room_one\.npz: expected one array.*found a, b"):
        scored(PredictionFolder(tmp_path))
    with pytest.raises(FrameError, match=r"keys z; found a, b"):
        scored(PredictionFolder(tmp_path, key="z"))
    np.savez(path, a=np.array(["x"]))
    with pytest.raises(FrameError, match="expected an array of numbers"):
        scored(PredictionFolder(tmp_path))
    path.write_bytes(b"PK not a zip")
    with pytest.raises(FrameError, match=r"room_one\.npz: no readable \.npz"):
        scored(PredictionFolder(tmp_path))


def test_a_truncated_array_is_named(tmp_path: Path) -> None:
    path = tmp_path / "room_one.npy"
    write(path, np.stack(ALL))
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(FrameError, match="ends within frame 5 of 6"):
        scored(PredictionFolder(tmp_path))


def test_mixed_kinds_of_files_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "room" / "one" / "11.npy", ALL[0])
    write(tmp_path / "room" / "one" / "13.exr", ALL[0])
    with pytest.raises(DataError, match=r"files of one kind, found \.exr, \.npy"):
        scored(PredictionFolder(tmp_path))


FRAME = BenchmarkFrame(np.zeros((*SIZE, 3), np.uint8), np.ones(SIZE, np.float32))


def test_inverse_depth_is_inverted_and_disparity_is_not() -> None:
    def arrays(_: BenchmarkSequence) -> Iterator[np.ndarray]:
        return iter([np.array([[4.0, 0.0, -1.0]])] * 3)

    inverse = ArrayMethod("m", "inverse", arrays)
    assert inverse.quantity == "depth"
    found = inverse.open(sequence())(0, FRAME)["m"]
    np.testing.assert_array_equal(found, [[0.25, np.nan, np.nan]])
    disparity = ArrayMethod("m", "disparity", arrays)
    assert disparity.quantity == "disparity"
    np.testing.assert_array_equal(disparity.open(sequence())(0, FRAME)["m"], [[4, 0, -1]])
    with pytest.raises(DataError, match="quantity 'metres' is unknown"):
        ArrayMethod("m", "metres", arrays)


def test_an_iterator_that_ends_too_early_is_named() -> None:
    predict = ArrayMethod("mine", "depth", lambda _: iter([np.ones(SIZE)])).open(sequence())
    predict(0, FRAME)
    with pytest.raises(FrameError, match="room/one: mine ends after 1 of 3 frames"):
        predict(1, FRAME)
