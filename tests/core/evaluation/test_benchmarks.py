"""Every benchmark on a made copy in its exact format: values, order, settings, what is missing."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.registry import (
    BENCHMARKS,
    BenchmarkFrame,
    BenchmarkSequence,
    BenchmarkSettings,
    open_benchmark,
)
from tests.support.made_benchmarks import (
    KITTI_SIZE,
    PATCH,
    SCANNET_CAMERA,
    SCANNET_COLOUR,
    SCANNET_DEPTH,
    SINTEL_MATRIX,
    SINTEL_SIZE,
    TUM_SIZE,
    depth,
    image,
    make_kitti,
    make_scannet,
    make_seven_scenes,
    make_sintel,
    make_tum,
    make_video,
    over_colour,
    pose,
    write_depth,
    write_image,
)


def known_truth(index: int, size: tuple[int, int]) -> np.ndarray:
    truth = depth(index, size)
    truth[PATCH] = np.nan
    return truth


def only(
    name: str, root: Path, settings: BenchmarkSettings | None = None, **options: bool
) -> BenchmarkSequence:
    (sequence,) = open_benchmark(name, root, settings, allow_missing=True, **options).sequences
    return sequence


def check(
    frame: BenchmarkFrame,
    index: int,
    size: tuple[int, int],
    step: float,
    wanted: np.ndarray | None = None,
) -> None:
    """The frame's truth within half a stored step, and its image."""
    wanted = known_truth(index, size) if wanted is None else wanted
    np.testing.assert_array_equal(np.isnan(frame.truth), np.isnan(wanted))
    np.testing.assert_allclose(frame.truth, wanted, rtol=1e-6, atol=0.51 * step)
    assert frame.truth.dtype == np.float32 and frame.image.dtype == np.uint8


def test_sintel_depth_cameras_and_both_passes(tmp_path: Path) -> None:
    make_sintel(tmp_path, {"alley_1": 3})
    sequence = only("sintel", tmp_path)
    assert (sequence.name, sequence.numbers) == ("alley_1", (1, 2, 3))
    for index, frame in enumerate(sequence.frames()):
        far = frame.truth == np.float32(1e11)
        assert far[PATCH].all() and far.sum() == far[PATCH].size
        np.testing.assert_allclose(frame.truth[~far], depth(index, SINTEL_SIZE)[~far], rtol=1e-6)
        np.testing.assert_array_equal(frame.image, image(index, SINTEL_SIZE))
        assert frame.camera_matrix is not None and frame.pose is not None
        np.testing.assert_allclose(frame.camera_matrix, SINTEL_MATRIX)
        np.testing.assert_allclose(frame.pose, pose(index), atol=1e-12)
    final = next(only("sintel-final", tmp_path).frames())
    np.testing.assert_array_equal(final.image, image(1, SINTEL_SIZE))


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"PIEHPIEH", "begins with float32"), (None, "expected 64 x 28 float32")],
)
def test_a_broken_dpt_is_named(tmp_path: Path, content: bytes | None, message: str) -> None:
    make_sintel(tmp_path, {"alley_1": 1})
    path = tmp_path / "training/depth/alley_1/frame_0001.dpt"
    path.write_bytes(path.read_bytes()[:-4] if content is None else content)
    with pytest.raises(FrameError, match=rf"frame_0001\.dpt: .*{message}"):
        next(only("sintel", tmp_path).frames())


def test_scannet_values_crop_stride_and_lost_poses(tmp_path: Path) -> None:
    make_scannet(tmp_path / "scans_test", "scene0707_00", 10)
    sequence = only("scannet", tmp_path)
    assert sequence.numbers == (0, 3, 6, 9)  # numeric order, every third
    for number, frame in zip(sequence.numbers, sequence.frames(), strict=True):
        wanted = known_truth(number, SCANNET_DEPTH)[8:-8, 11:-11]
        np.testing.assert_allclose(frame.truth, wanted, atol=0.00051)
        assert frame.image.shape == (104, 138, 3)
        colour = image(number, SCANNET_DEPTH)[8:-8, 11:-11]
        assert np.abs(frame.image.astype(int) - colour).mean() < 2  # JPEG and resizing
        assert (frame.pose is None) == (number == 3)
        assert frame.camera_matrix is not None
        fx, _, cx, _ = SCANNET_CAMERA
        ratio = SCANNET_DEPTH[1] / SCANNET_COLOUR[1]
        assert frame.camera_matrix[0, 0] == pytest.approx(fx * ratio, rel=1e-6)
        assert frame.camera_matrix[0, 2] == pytest.approx((cx + 0.5) * ratio - 0.5 - 11, abs=1e-4)


def test_scannet_crop_before_resize_is_the_released_fault_and_ours_is_registered(
    tmp_path: Path,
) -> None:
    """An edge at a quarter of the width, in colour (1296 x 968) and depth (640 x 480).

    The released data are cropped by the same pixels first and resized then: its edges are 2.8
    pixels apart. Ours are not apart.
    """
    picture = np.zeros((968, 1296, 3), np.uint8)
    picture[:, 324:] = 255
    metres = np.where(np.arange(640) < 160, 2.0, 4.0) * np.ones((480, 1))
    make_scannet(tmp_path, "scene0707_00", 1)
    folder = tmp_path / "scene0707_00"
    write_image(folder / "color/0.jpg", picture)
    write_depth(folder / "depth/0.png", metres, 1000)
    frame = next(only("scannet", tmp_path).frames())

    def edge(row: np.ndarray, width: int) -> float:
        """Where a row rises past the middle of its range, as a share of its width."""
        return float(np.argmax(row > (row.min() + row.max()) / 2)) / width

    released_colour = picture[8:-8, 11:-11, 0][400].astype(float)
    released_depth = metres[8:-8, 11:-11][200]
    released = edge(released_colour, 1274) - edge(released_depth, 618)
    ours = edge(frame.image[200, :, 0].astype(float), 618) - edge(frame.truth[200], 618)
    assert abs(released * 618) == pytest.approx(2.8, abs=0.3)
    assert abs(ours * 618) <= 0.5


def test_kitti_unit_frames_with_truth_and_calibration(tmp_path: Path) -> None:
    make_kitti(tmp_path, "2011_09_26_drive_0002_sync", range(5, 9))
    sequence = only("kitti", tmp_path)
    assert sequence.numbers == (5, 6, 7, 8)
    for number, frame in zip(sequence.numbers, sequence.frames(), strict=True):
        check(frame, number, KITTI_SIZE, 1 / 256)
        np.testing.assert_array_equal(frame.image, image(number % 5, KITTI_SIZE))
        assert frame.camera_matrix is not None
        np.testing.assert_allclose(frame.camera_matrix[0], [90, 0, 39.5])


def test_an_eight_bit_depth_is_named(tmp_path: Path) -> None:
    make_kitti(tmp_path, "2011_09_26_drive_0002_sync", range(5, 6))
    path = next((tmp_path / "val").rglob("*.png"))
    write_image(path, image(0, KITTI_SIZE))
    with pytest.raises(FrameError, match=rf"{path.name}: expected a grey 16-bit PNG"):
        next(only("kitti", tmp_path).frames())


def test_a_wrong_size_is_named(tmp_path: Path) -> None:
    make_kitti(tmp_path, "2011_09_26_drive_0002_sync", range(5, 6))
    path = next((tmp_path / "val").rglob("*.png"))
    write_depth(path, depth(5, (20, 80)), 256)
    with pytest.raises(FrameError, match=r"depth of \(20, 80\), but the image has \(30, 80\)"):
        next(only("kitti", tmp_path).frames())


def test_bonn_takes_frames_30_to_139_and_no_pose(tmp_path: Path) -> None:
    make_tum(tmp_path / "rgbd_bonn_crowd2", 34)
    sequence = only("bonn", tmp_path)
    assert sequence.numbers == (30, 31, 32, 33)
    assert BENCHMARKS["bonn"].settings == BenchmarkSettings(first=30, frames=110, depth_max=10)
    for number, frame in zip(sequence.numbers, sequence.frames(), strict=True):
        check(frame, number, TUM_SIZE, 1 / 5000)
        assert frame.pose is None and frame.camera_matrix is not None
        assert frame.camera_matrix[0, 0] == pytest.approx(542.822841 / 20, rel=1e-6)


def test_tum_depth_is_matched_by_stamp_and_not_by_order(tmp_path: Path) -> None:
    make_tum(tmp_path / "rgbd_dataset_freiburg3_walking", 5, lost_depth=1)
    sequence = only("tum", tmp_path)
    assert sequence.numbers == (0, 2, 3, 4)
    for number, frame in zip(sequence.numbers, sequence.frames(), strict=True):
        check(frame, number, TUM_SIZE, 1 / 5000)
        assert frame.pose is not None and frame.camera_matrix is not None
        np.testing.assert_allclose(frame.pose, pose(number), atol=1e-12)
        assert frame.camera_matrix[0, 0] == pytest.approx(535.4 / 20, rel=1e-6)


def test_seven_scenes_test_sequences(tmp_path: Path) -> None:
    make_seven_scenes(tmp_path / "chess" / "seq-03", 3)
    make_seven_scenes(tmp_path / "chess" / "seq-01", 3)  # training
    opened = open_benchmark("7scenes", tmp_path, allow_missing=True)
    (sequence,) = opened.sequences
    assert sequence.name == "chess/seq-03"
    assert opened.report.problems["sequence that is not part of the benchmark"] == ["chess/seq-01"]
    for index, frame in enumerate(sequence.frames()):
        wanted = over_colour(known_truth(index, (24, 32)))
        check(frame, index, (24, 32), 1 / 1000, wanted)
        assert frame.pose is not None
        np.testing.assert_allclose(frame.pose, pose(index))


@pytest.mark.parametrize("name", ["sintel", "scannet", "kitti", "bonn", "tum", "7scenes"])
def test_depthcrafter_layout_of_every_set(tmp_path: Path, name: str) -> None:
    known = BENCHMARKS[name]
    assert known.video_set is not None
    sequence_name = known.sequences[0] if known.sequences else "some_room"
    make_video(tmp_path / known.video_set, sequence_name.replace("/", "_"), 4)
    opened = open_benchmark(name, tmp_path, allow_missing=True)
    assert opened.layout == "depthcrafter"
    assert opened.settings.crop == (0, 0) and opened.settings.stride == 1
    assert opened.settings.depth_max == known.settings.depth_max
    (sequence,) = opened.sequences
    assert sequence.name == sequence_name
    frames = list(sequence.frames())
    assert len(frames) == len(sequence) == 4
    for index, frame in enumerate(frames):
        check(frame, index, (24, 32), 0)
        assert np.abs(frame.image.astype(int) - image(index, (48, 64))).mean() < 8  # video codec
        assert np.abs(int(np.median(frame.image[..., 0])) - (40 + 20 * index)) < 8  # right frame


def test_depthcrafter_files_are_checked(tmp_path: Path) -> None:
    folder = tmp_path / "sintel"
    make_video(folder, "alley_1", 3)
    truth = folder / "alley_1_disparity.npz"
    np.savez(truth, depth=np.ones((3, 1, 4, 4)), other=np.ones(3))
    with pytest.raises(DataError, match="keys disparity, arr_0; found depth, other"):
        only("sintel", tmp_path)
    np.savez(truth, disparity=np.ones((3, 2, 4, 4)))
    with pytest.raises(DataError, match=r"expected T x H x W.*\(3, 2, 4, 4\)"):
        only("sintel", tmp_path)
    np.savez(truth, disparity=np.ones((5, 1, 24, 32)))
    with pytest.raises(FrameError, match=r"ends before frame 3, but alley_1_disparity\.npz"):
        list(only("sintel", tmp_path).frames())
    truth.unlink()
    with pytest.raises(DataError, match=r"video without its _disparity\.npz"):
        only("sintel", tmp_path)


def test_an_incomplete_root_says_what_is_missing_and_scores_the_rest_when_asked(
    tmp_path: Path,
) -> None:
    make_sintel(tmp_path, {"ambush_6": 20, "ambush_2": 4})
    with pytest.raises(DataError) as refused:
        open_benchmark("sintel", tmp_path)
    text = str(refused.value)
    assert "incomplete" in text and "--allow-missing" in text
    assert "alley_1" in text and "ambush_2 (4 of 21 frames)" in text and "ambush_6" not in text
    opened = open_benchmark("sintel", tmp_path, allow_missing=True)
    assert [s.name for s in opened.sequences] == ["ambush_2", "ambush_6"]
    assert len(opened.missing) == 22
    chosen = open_benchmark("sintel", tmp_path, sequences=["ambush_6"])
    assert chosen.missing == [] and len(chosen.sequences[0]) == 20
    with pytest.raises(DataError, match="missing: nowhere"):
        open_benchmark("sintel", tmp_path, sequences=["ambush_6", "nowhere"])


def test_a_sequence_that_cannot_be_opened_is_missing_and_the_others_are_scored(
    tmp_path: Path,
) -> None:
    make_tum(tmp_path / "rgbd_dataset_freiburg1_good", 3)
    make_tum(tmp_path / "rgbd_dataset_freiburg1_bad", 3)
    (tmp_path / "rgbd_dataset_freiburg1_bad" / "depth.txt").unlink()
    with pytest.raises(DataError, match=r"missing: .*freiburg1_bad.depth\.txt: cannot be read"):
        open_benchmark("tum", tmp_path)
    opened = open_benchmark("tum", tmp_path, allow_missing=True)
    assert [s.name for s in opened.sequences] == ["rgbd_dataset_freiburg1_good"]
    assert len(opened.missing) == 1


def test_what_the_paper_says_is_the_default() -> None:
    counts = {name: len(BENCHMARKS[name].sequences) for name in ("sintel", "scannet", "kitti")}
    assert counts == {"sintel": 23, "scannet": 100, "kitti": 13}
    assert len(BENCHMARKS["bonn"].sequences) == 5
    assert sum(BENCHMARKS["sintel"].lengths.values()) == 1064
    caps = {name: BENCHMARKS[name].settings.depth_max for name in (*counts, "bonn")}
    assert caps == {"sintel": 70, "scannet": 10, "kitti": 80, "bonn": 10}
    assert BENCHMARKS["scannet"].settings.crop == (8, 11)
    frames = [BENCHMARKS[name].settings.frames for name in (*counts, "bonn")]
    assert frames == [50, 90, 110, 110]


def test_settings_are_overridden(tmp_path: Path) -> None:
    make_scannet(tmp_path, "scene0707_00", 9)
    sequence = only(
        "scannet", tmp_path, BenchmarkSettings(first=1, stride=2, frames=3, crop=(0, 20))
    )
    assert sequence.numbers == (1, 3, 5)
    assert next(sequence.frames()).truth.shape == (120, 120)
    with pytest.raises(FrameError, match="leaves nothing"):
        next(only("scannet", tmp_path, BenchmarkSettings(crop=(60, 0))).frames())
    with pytest.raises(ValueError, match="stride"):
        BenchmarkSettings(stride=0)


def test_unknown_names_and_empty_roots_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="did you mean 'scannet'"):
        open_benchmark("scanet", tmp_path)
    with pytest.raises(DataError, match="found an empty folder"):
        open_benchmark("tum", tmp_path)
    with pytest.raises(DataError, match="does not exist"):
        open_benchmark("bonn", tmp_path / "nothing")
    with pytest.raises(DataError, match="unknown layout"):
        open_benchmark("bonn", tmp_path, layout="zip")


def test_a_plain_folder_is_a_benchmark_too(tmp_path: Path) -> None:
    make_tum(tmp_path / "room_freiburg1", 3)
    shutil.copytree(tmp_path / "room_freiburg1", tmp_path / "b" / "freiburg2")
    opened = open_benchmark("rgbd", tmp_path)
    assert [s.name for s in opened.sequences] == ["b/freiburg2", "room_freiburg1"]
    check(next(opened.sequences[0].frames()), 0, TUM_SIZE, 1 / 5000)
