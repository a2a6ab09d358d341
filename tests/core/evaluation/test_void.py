"""VOID on a made copy, and metres by a benchmark's points or poses: scores by value."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dyfn_core.cli import eval as cli
from dyfn_core.cli import eval_commands
from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.metres import MetresStream
from dyfn_core.evaluation.benchmarks.model_method import ModelMethod
from dyfn_core.evaluation.benchmarks.published import published_metres
from dyfn_core.evaluation.benchmarks.registry import open_benchmark
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkFrame
from dyfn_core.evaluation.choices import METRES, POSES
from tests.support.made_benchmarks import (
    PATCH,
    VOID_CAMERA,
    VOID_SEQUENCE,
    VOID_SIZE,
    depth,
    image,
    make_void,
    pose,
    void_name,
    write_depth,
    write_image,
    write_uint16,
)
from tests.support.pinhole import PinholeModel
from tests.support.textured_plane import CAMERA, plane_view, texture, walk

UNIT = 2.0  # metres in one unit of the pinhole model


def test_values_order_and_what_is_scored(tmp_path: Path) -> None:
    make_void(tmp_path, 500, 4, scored=[0, 2])
    (sequence,) = open_benchmark("void-500", tmp_path).sequences
    assert (sequence.name, sequence.numbers) == (VOID_SEQUENCE, (0, 1, 2, 3))
    frames = list(sequence.frames())
    assert [frame.context for frame in frames] == [False, True, False, True]
    assert [frame.stamp for frame in frames] == [float(void_name(i)[:-4]) for i in range(4)]
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, image(index, VOID_SIZE))
        assert frame.camera_matrix is not None and frame.sparse is not None
        np.testing.assert_allclose(frame.camera_matrix, VOID_CAMERA)
        known = np.zeros(VOID_SIZE, bool)
        known[::4, ::4] = True
        known[0, 0] = False  # by the validity map
        np.testing.assert_array_equal(np.isfinite(frame.sparse), known)
        wanted = depth(index, VOID_SIZE)
        np.testing.assert_allclose(frame.sparse[known], wanted[known], atol=0.51 / 256)
        assert (frame.pose is None) == (index == 1)
        if frame.pose is not None:
            np.testing.assert_allclose(frame.pose, pose(index))
        if frame.context:
            assert np.isnan(frame.truth).all()
            continue
        wanted[PATCH] = np.nan
        wanted[wanted >= 5] = np.nan
        np.testing.assert_array_equal(np.isnan(frame.truth), np.isnan(wanted))
        np.testing.assert_allclose(frame.truth, wanted, atol=0.51 / 256)


def test_truth_outside_of_20_cm_to_5_m_does_not_count(tmp_path: Path) -> None:
    folder = make_void(tmp_path, 150, 1, scored=[0])
    truth = np.tile(np.array([0.1, 0.19, 0.21, 4.99, 5.01, 9.0, 1.0, 2.0]), (24, 4))
    write_depth(folder / "data" / VOID_SEQUENCE / "ground_truth" / void_name(0), truth, 256)
    frame = next(open_benchmark("void-150", tmp_path).sequences[0].frames())
    found = np.isfinite(frame.truth[-1, :8])
    assert found.tolist() == [False, False, True, True, False, False, True, True]


def test_the_folder_of_a_density_is_a_root_too(tmp_path: Path) -> None:
    folder = make_void(tmp_path, 1500, 2, scored=[0, 1])
    assert len(open_benchmark("void-1500", folder).sequences) == 1
    with pytest.raises(DataError, match="void_150/data"):
        open_benchmark("void-150", folder)


def test_what_is_missing_or_wrong_is_named(tmp_path: Path) -> None:
    folder = make_void(tmp_path, 150, 3, scored=[0, 1, 2])
    sequence = folder / "data" / VOID_SEQUENCE
    (sequence / "image" / void_name(2)).unlink()
    with pytest.raises(DataError, match=r"classroom0 \(1 of 3 listed images are not there\)"):
        open_benchmark("void-150", tmp_path)
    opened = open_benchmark("void-150", tmp_path, allow_missing=True)
    assert len(opened.sequences[0]) == 2 and len(opened.missing) == 1
    write_uint16(sequence / "sparse_depth" / void_name(1), np.zeros((12, 16)))
    with pytest.raises(FrameError, match=r"sparse_depth/100.0333.png: depth of \(12, 16\), but"):
        list(opened.sequences[0].frames())
    listing = folder / "test_image.txt"
    listing.write_text("classroom0/100.png\n")
    with pytest.raises(DataError, match=r"test_image.txt: expected lines such as .*100.png"):
        open_benchmark("void-150", tmp_path)
    listing.unlink()
    with pytest.raises(DataError, match=r"folder without test_image.txt"):
        open_benchmark("void-150", tmp_path)


def write_slope(folder: Path, index: int) -> None:
    """Truth that PinholeModel reads off the image in another unit; points without noise."""
    sequence, name = folder / "data" / VOID_SEQUENCE, void_name(index)
    rows, columns = np.mgrid[: VOID_SIZE[0], : VOID_SIZE[1]]
    red = np.round(20 + 4 * columns + 3 * rows + 5 * index).astype(np.uint8)
    metres = UNIT * (red / 255 + 0.5)
    picture = np.zeros((*VOID_SIZE, 3), np.uint8)
    picture[..., 0] = red
    write_image(sequence / "image" / name, picture)
    write_uint16(sequence / "ground_truth" / name, np.round(metres * 256))
    points = np.zeros(VOID_SIZE)
    points[::4, ::4] = metres[::4, ::4]
    write_uint16(sequence / "sparse_depth" / name, np.round(points * 256))


def test_metres_by_given_points_stand_beside_the_published_ones(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make_void(tmp_path / "release", 150, 6, scored=[1, 4])
    for index in range(6):
        write_slope(folder, index)
    monkeypatch.setattr(eval_commands, "load_model", lambda *_: PinholeModel().eval())
    arguments = ["run", "--benchmark", "void-150", "--data", str(tmp_path / "release")]
    arguments += ["--model", "pinhole", "--metres-from", "points", "--no-controls"]
    arguments += ["--no-temporal", "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    results: dict[str, Any] = json.loads((tmp_path / "out" / "results.json").read_text())
    assert results["in_metres"] == ["pinhole, base + points"] and not results["warnings"]
    found = results["variants"]["pinhole, base + points"]
    assert found["scored_frames"] == 2
    assert found["metric"]["mae"] < 0.01  # metres; stored in steps of 4 mm
    assert found["metric"]["i_mae"] < 0.005
    unaligned = results["variants"]["pinhole, base"]["metric"]
    assert unaligned["abs_rel"] == pytest.approx(1 - 1 / UNIT, abs=0.01)
    printed = capsys.readouterr().out
    mae = f"{1000 * found['metric']['mae']:.3f}"
    for text in ("iRMSE 1/km", mae, "VI-Depth, DPT-BEiT-Large, scale map", "34.250"):
        assert text in printed
    table = (tmp_path / "out" / "metres.md").read_text()
    assert "pinhole, base + points" in table and "published" in table
    assert "In metres, without alignment" in (tmp_path / "out" / "report.html").read_text()


def test_files_are_scored_in_metres_over_all_frames(tmp_path: Path) -> None:
    make_void(tmp_path / "release", 150, 3, scored=[0, 2])
    (tmp_path / "mine").mkdir()
    off = np.stack([depth(i, VOID_SIZE) + 0.1 * i for i in range(3)])
    np.save(tmp_path / "mine" / f"{VOID_SEQUENCE}.npy", off)
    arguments = ["score", "--benchmark", "void-150", "--data", str(tmp_path / "release")]
    arguments += ["--predictions", str(tmp_path / "mine"), "--quantity", "depth"]
    assert cli.main([*arguments, "--no-temporal", "--out", str(tmp_path / "out")]) == 0
    row = (tmp_path / "out" / "metres.csv").read_text().splitlines()[1].split(",")
    assert row[0] == "mine" and row[-2:] == ["2", "measured"]
    assert float(row[1]) == pytest.approx((0 + 200) / 2, abs=2)  # MAE in mm
    assert float(row[2]) == pytest.approx((0 + 200) / 2, abs=3)  # of each frame, then the mean


def test_metres_by_triangulation_with_the_poses() -> None:
    """Also without stamps; nothing is in metres before the odometry has agreed for a while."""
    stream, whole, found = MetresStream(POSES, "plane"), texture(), []
    for index, camera_pose in enumerate(walk(44, step=0.02, turn=0.002)):
        view = plane_view(camera_pose, whole, CAMERA)
        frame = BenchmarkFrame(view.image, view.depth, CAMERA, camera_pose)
        metres = stream.push(index, frame, view.depth / np.float32(UNIT))
        found.append(np.abs(metres / view.depth - 1))
    assert np.isnan(found[0]).all()
    assert np.mean(found[-1]) < 0.03


def test_metres_that_a_benchmark_cannot_give_are_refused() -> None:
    frame = BenchmarkFrame(np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32))
    with pytest.raises(DataError, match="s: metres need intrinsics"):
        MetresStream("poses", "s").push(0, frame, frame.truth)
    with pytest.raises(DataError, match="s: the benchmark gives no sparse points"):
        MetresStream("points", "s").push(0, replace(frame, camera_matrix=VOID_CAMERA), frame.truth)
    disparity = PinholeModel()
    disparity.quantity = "disparity"
    with pytest.raises(DataError, match="predicts disparity"):
        ModelMethod("m", disparity, metres_from=METRES)


def test_points_of_another_size_than_the_image() -> None:
    """Truth and points at half the image's size, depth rising to the right."""
    metres = np.tile(np.linspace(1, 3, 32, dtype=np.float32), (24, 1))
    sparse = np.full((24, 32), np.nan, np.float32)
    sparse[2::4, 2::4] = metres[2::4, 2::4]
    picture = np.zeros((48, 64, 3), np.uint8)
    frame = BenchmarkFrame(picture, metres, 2 * VOID_CAMERA, sparse=sparse)
    predicted = cv2.resize(metres, (64, 48)) / np.float32(4)
    found = MetresStream("points", "s").push(0, frame, predicted)
    np.testing.assert_allclose(found, 4 * predicted, rtol=0.02)


def test_published_rows_are_of_one_benchmark() -> None:
    assert [row.i_rmse for row in published_metres("void-150")] == [72.70, 57.13]
    assert published_metres("void-500") == published_metres("bonn") == []
