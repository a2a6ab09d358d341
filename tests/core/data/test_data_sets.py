"""The published training sets: made copies in their exact formats, read back by value."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from dyfn_core.data.datasets import open_kind
from dyfn_core.data.frames import DataError, FrameError, RgbdFrame
from tests.support.made_data_sets import BALL, FLOOR, MAKERS, PATCH, RADIUS, MadeSet, View


@pytest.fixture(scope="module", params=list(MAKERS))
def made(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, MadeSet]:
    root = tmp_path_factory.mktemp(request.param)
    return root, MAKERS[request.param](root)


@pytest.fixture
def copy(made: tuple[Path, MadeSet], tmp_path: Path) -> tuple[Path, MadeSet, Path]:
    """A copy to damage, and the path there of the middle frame's depth."""
    root, known = made
    shutil.copytree(root, tmp_path / "copy", copy_function=shutil.copy)
    depth = known.depth_file(known.numbers[1]).relative_to(root)
    return tmp_path / "copy", known, tmp_path / "copy" / depth


def expected_depth(known: MadeSet, view: View) -> np.ndarray:
    depth = view.depth if known.sky else np.where(np.isinf(view.depth), np.nan, view.depth)
    depth = depth.copy()
    depth[PATCH] = np.nan
    return depth


def test_images_depth_and_intrinsics_come_back_by_value(made: tuple[Path, MadeSet]) -> None:
    root, known = made
    (sequence,), report = open_kind(known.kind, root, {})
    assert len(sequence) == report.frames == 3
    for index, view in enumerate(known.views):
        frame = sequence.read(index)
        height, width = view.depth.shape
        assert frame.image.dtype == np.uint8
        assert np.abs(frame.image.astype(int) - view.image).mean() < 8  # JPEG; channels swapped: 30
        wanted = expected_depth(known, view)
        np.testing.assert_array_equal(np.isposinf(frame.depth), np.isposinf(wanted))
        np.testing.assert_array_equal(np.isnan(frame.depth), np.isnan(wanted))
        near = np.isfinite(wanted)
        assert near.mean() > 0.3
        np.testing.assert_allclose(
            frame.depth[near], wanted[near], rtol=known.step, atol=known.step
        )
        normalised = np.array(view.camera) / [width, height, width, height]
        np.testing.assert_allclose(frame.intrinsics, normalised, rtol=1e-6)
        assert frame.depth.dtype == frame.intrinsics.dtype == np.float32


def test_poses_put_every_frame_into_one_scene(made: tuple[Path, MadeSet]) -> None:
    """Unprojected by what the loader says, each pixel is on the floor or on the ball."""
    root, known = made
    (sequence,), _ = open_kind(known.kind, root, {})
    for index, view in enumerate(known.views):
        frame = sequence.read(index)
        if known.to_world is None:
            assert frame.pose is None
            continue
        assert frame.pose is not None
        np.testing.assert_allclose(frame.pose, known.to_world @ view.pose, atol=1e-5)
        points = scene_points(frame) @ np.linalg.inv(known.to_world)[:3, :3].T
        on_floor = np.abs(points[:, 1] - FLOOR)
        on_ball = np.abs(np.linalg.norm(points - BALL, axis=-1) - RADIUS)
        error = np.minimum(on_floor, on_ball) / np.linalg.norm(points, axis=-1)
        assert np.quantile(error, 0.99) < 2 * known.step + 1e-4
        assert (on_ball < 0.02).sum() > 20


def scene_points(frame: RgbdFrame) -> np.ndarray:
    """N x 3 of the finite pixels, in the pose's world."""
    height, width = frame.depth.shape
    rows, cols = np.nonzero(np.isfinite(frame.depth))
    fx, fy, cx, cy = frame.intrinsics
    z = frame.depth[rows, cols].astype(np.float64)
    x = ((cols + 0.5) / width - cx) / fx * z
    y = ((rows + 0.5) / height - cy) / fy * z
    assert frame.pose is not None
    return np.stack([x, y, z], -1) @ frame.pose[:3, :3].T + frame.pose[:3, 3]


def test_a_missing_depth_is_counted_and_splits_the_sequence(
    copy: tuple[Path, MadeSet, Path],
) -> None:
    root, known, depth = copy
    depth.unlink()
    sequences, report = open_kind(known.kind, root, {})
    assert [len(sequence) for sequence in sequences] == [1, 1]
    names = [
        name for reason, names in report.problems.items() if "depth" in reason for name in names
    ]
    (name,) = names
    assert f"{known.numbers[1]:04d}" in Path(name).name
    assert report.summary().startswith(f"{known.kind} at {root}: 2 frames in 2 sequences; ")


def test_an_unreadable_depth_is_an_error_that_names_the_file(
    copy: tuple[Path, MadeSet, Path],
) -> None:
    root, known, depth = copy
    depth.write_bytes(b"no depth at all")
    (sequence,), _ = open_kind(known.kind, root, {})
    with pytest.raises(FrameError, match=depth.name):
        sequence.read(1)
    assert sequence.read(2).image.shape == known.views[2].image.shape


@pytest.mark.parametrize("kind", list(MAKERS))
def test_a_root_of_something_else_says_what_is_expected_and_found(
    kind: str, tmp_path: Path
) -> None:
    (tmp_path / "holiday.txt").touch()
    with pytest.raises(DataError, match=r"expected .+; found holiday.txt"):
        open_kind(kind, tmp_path, {})
    with pytest.raises(DataError, match="does not exist; expected"):
        open_kind(kind, tmp_path / "nowhere", {})


def test_point_odyssey_without_annotations_is_counted(tmp_path: Path) -> None:
    MAKERS["point_odyssey"](tmp_path)
    (tmp_path / "train" / "made_walk" / "anno.npz").unlink()
    with pytest.raises(DataError, match=r"1 x sequence without anno.npz or annot.npz"):
        open_kind("point_odyssey", tmp_path, {})


def test_broken_sequence_of_dynamic_replica_is_left_out_and_named(tmp_path: Path) -> None:
    MAKERS["dynamic_replica"](tmp_path)
    sequences, report = open_kind("dynamic_replica", tmp_path, {})
    assert [sequence.name for sequence in sequences] == ["made-1_obj_left"]
    assert report.problems == {"sequence that is known to be broken": ["009850-3_obj_source_left"]}


def test_tartanair_with_fewer_poses_than_frames_keeps_the_frames(tmp_path: Path) -> None:
    MAKERS["tartanair"](tmp_path)
    poses = tmp_path / "office" / "Easy" / "P000" / "pose_left.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:2]))
    (sequence,), _ = open_kind("tartanair", tmp_path, {})
    assert [sequence.read(index).pose is None for index in range(3)] == [False, False, True]


@pytest.mark.parametrize("quaternion", ["0 0 0 0", "nan 0 0 1"])
def test_a_pose_that_is_none_is_counted_and_the_frame_stays(
    quaternion: str, tmp_path: Path
) -> None:
    MAKERS["tartanair"](tmp_path)
    poses = tmp_path / "office" / "Easy" / "P000" / "pose_left.txt"
    lines = poses.read_text().splitlines()
    lines[1] = f"0 0 0 {quaternion}"
    poses.write_text("\n".join(lines))
    (sequence,), report = open_kind("tartanair", tmp_path, {})
    assert [sequence.read(index).pose is None for index in range(3)] == [False, True, False]
    assert "1 x pose that is none (the frame stays)" in report.summary()
    assert "pose_left.txt row 1" in report.summary()


def test_midair_with_a_zero_quaternion_keeps_the_frames(tmp_path: Path) -> None:
    MAKERS["midair"](tmp_path)
    (path,) = tmp_path.rglob("sensor_records.hdf5")
    with h5py.File(path, "r+") as file:
        attitudes: list[h5py.Dataset] = []
        file.visititems(
            lambda name, found: attitudes.append(found) if name.endswith("attitude") else None
        )
        for attitude in attitudes:
            attitude[0] = 0
    sequences, report = open_kind("midair", tmp_path, {})
    assert sequences[0].read(0).pose is None
    assert sequences[0].read(1).pose is not None
    assert "pose that is none" in report.summary()


def test_unusable_intrinsics_of_spring_name_the_image(tmp_path: Path) -> None:
    known = MAKERS["spring"](tmp_path)
    (path,) = tmp_path.rglob("intrinsics.txt")
    path.write_text("\n".join(["nan 0 0 0"] * len(known.views)))
    (sequence,), _ = open_kind("spring", tmp_path, {})
    with pytest.raises(FrameError, match=r"frame_left_0001.png: unusable intrinsics fx=nan"):
        sequence.read(0)


def test_another_size_than_the_published_one_is_refused(tmp_path: Path) -> None:
    known = MAKERS["tartanair"](tmp_path)
    image = known.depth_file(0).parents[1] / "image_left" / "000000_left.png"
    cv2.imwrite(str(image), np.zeros((240, 320, 3), np.uint8))
    (sequence,), _ = open_kind("tartanair", tmp_path, {})
    with pytest.raises(FrameError, match=r"000000_left.png: expected an image of \(480, 640\)"):
        sequence.read(0)
