"""RGB-D folders, several data sets together, cuts, clips and frames that cannot be read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dyfn_core.data.clips import (
    BatchLoader,
    ClipSource,
    SizeStage,
    draw_batch,
    draw_clip,
    find_sequences,
)
from dyfn_core.data.datasets import open_kind, recognise
from dyfn_core.data.frames import DataError, FrameError, NumberedSequence, RgbdFrame
from dyfn_core.data.pool import DataPool, DataSpec, cut_sequences, open_pool
from dyfn_core.training.config import BaseRunConfig, ConfigError, read_config
from dyfn_core.training.tasks.validation import spread_examples
from tests.support.made_data_sets import (
    BALL,
    FLOOR,
    RADIUS,
    View,
    make_point_odyssey,
    view,
    write_jpeg,
    write_png,
)
from tests.support.made_frames import write_data_set

SIZE = (48, 64)
CAMERA = (50.0, 52.0, 31.0, 25.0)  # the first pixel's corner at 0


def pixels(camera: tuple[float, float, float, float]) -> list[list[float]]:
    fx, fy, cx, cy = camera
    return [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]


def stored(shown: View, unit: float) -> np.ndarray:
    metres = np.where(np.isfinite(shown.depth), shown.depth, 0)
    return np.round(np.minimum(metres * unit, 65534)).astype(np.uint16)


def make_plain(root: Path) -> None:
    shown = [view(i, SIZE, CAMERA) for i in range(3)]
    for number, frame in zip((8, 9, 10), shown, strict=True):
        write_jpeg(root / "rgb" / f"{number}.jpg", frame.image)
        write_png(root / "depth" / f"{number}.png", stored(frame, 1000))
    np.savetxt(root / "K.txt", pixels(CAMERA))
    np.savetxt(root / "poses.txt", [frame.pose.reshape(-1) for frame in shown])


def make_scannet(root: Path) -> None:
    for i, number in enumerate((80, 90, 100)):
        frame = view(i, SIZE, CAMERA)
        large = cv2.resize(frame.image, (129, 97))
        write_jpeg(root / "color" / f"{number}.jpg", large)
        write_png(root / "depth" / f"{number}.png", stored(frame, 1000))
        (root / "pose").mkdir(exist_ok=True)
        np.savetxt(root / "pose" / f"{number}.txt", frame.pose)
    matrix = np.eye(4)
    fx, fy, cx, cy = CAMERA
    matrix[:3, :3] = pixels((fx * 129 / 64, fy * 97 / 48, cx * 129 / 64, cy * 97 / 48))
    (root / "intrinsic").mkdir()
    np.savetxt(root / "intrinsic" / "intrinsic_color.txt", matrix)


def make_seven_scenes(root: Path) -> None:
    for number in range(3):
        frame = view(number, SIZE, CAMERA)
        values = stored(frame, 1000)
        values[0] = 65535
        name = str(root / "seq-01" / f"frame-{number:06d}")
        write_png(Path(f"{name}.color.png"), frame.image)
        write_png(Path(f"{name}.depth.png"), values)
        np.savetxt(f"{name}.pose.txt", frame.pose)


def make_tum(root: Path) -> None:
    folder = root / "rgbd_dataset_made"
    colour, depth, truth = ["# colour"], ["# depth"], ["# truth"]
    for number in range(3):
        frame, stamp = view(number, SIZE, CAMERA), 9.99 + number / 30
        write_png(folder / "rgb" / f"{stamp:.6f}.png", frame.image)
        write_png(folder / "depth" / f"{stamp + 0.01:.6f}.png", stored(frame, 5000))
        colour.append(f"{stamp:.6f} rgb/{stamp:.6f}.png")
        depth.append(f"{stamp + 0.01:.6f} depth/{stamp + 0.01:.6f}.png")
        turn = Rotation.from_matrix(frame.pose[:3, :3]).as_quat()
        numbers = [stamp - 0.004, *frame.pose[:3, 3], *turn]
        truth.append(" ".join(f"{value:.9f}" for value in numbers))
    for name, lines in (("rgb", colour), ("depth", depth), ("groundtruth", truth)):
        (folder / f"{name}.txt").write_text("\n".join(lines))
    np.savetxt(folder / "K.txt", pixels(CAMERA))


@pytest.mark.parametrize("make", [make_plain, make_scannet, make_seven_scenes, make_tum])
def test_rgbd_folders_of_every_layout_are_read_by_value(
    make: Callable[[Path], None], tmp_path: Path
) -> None:
    make(tmp_path)
    options = {"intrinsics": tuple(np.array(CAMERA) - [0, 0, 0.5, 0.5])}
    assert recognise(tmp_path) == "rgbd_folder"
    given = options if make is make_seven_scenes else {}
    (sequence,), report = open_kind("rgbd_folder", tmp_path, given)
    assert not report.problems
    assert len(sequence) == 3
    for index in range(3):
        frame, truth = sequence.read(index), view(index, SIZE, CAMERA)
        if make is make_seven_scenes:
            assert np.isnan(frame.depth[0]).all()
            frame.depth[0], truth.depth[0] = np.nan, np.nan
        near = np.isfinite(truth.depth) & (truth.depth < 13)
        np.testing.assert_allclose(frame.depth[near], truth.depth[near], atol=6e-4)
        assert np.isnan(frame.depth[~np.isfinite(truth.depth)]).all()
        normalised = np.array(CAMERA) / [64, 48, 64, 48]
        np.testing.assert_allclose(frame.intrinsics, normalised, atol=1e-6)
        assert frame.pose is not None
        np.testing.assert_allclose(frame.pose, truth.pose, atol=1e-6)
        assert np.abs(frame.image.astype(int) - truth.image).mean() < 15


def test_a_pose_of_a_plain_folder_that_is_none_is_counted(tmp_path: Path) -> None:
    make_plain(tmp_path)
    poses = np.loadtxt(tmp_path / "poses.txt")
    poses[0] = np.nan
    np.savetxt(tmp_path / "poses.txt", poses)
    (sequence,), report = open_kind("rgbd_folder", tmp_path, {})
    assert sequence.read(0).pose is None
    assert sequence.read(1).pose is not None
    assert "poses.txt row 0" in report.summary()


def test_seven_scenes_takes_its_published_camera(tmp_path: Path) -> None:
    make_seven_scenes(tmp_path)
    (sequence,), _ = open_kind("rgbd_folder", tmp_path, {})
    np.testing.assert_allclose(sequence.read(0).intrinsics[:2], [525 / 640, 525 / 480], rtol=1e-6)


def test_folder_without_intrinsics_says_how_to_give_them(tmp_path: Path) -> None:
    make_plain(tmp_path)
    (tmp_path / "K.txt").unlink()
    with pytest.raises(DataError, match=r"K.txt is missing; give `intrinsics: \[fx, fy, cx, cy\]`"):
        open_kind("rgbd_folder", tmp_path, {})


def test_stamps_that_jump_and_depth_too_far_away_are_cuts_and_counted(tmp_path: Path) -> None:
    make_tum(tmp_path)
    folder = tmp_path / "rgbd_dataset_made"
    lines = (folder / "rgb.txt").read_text().splitlines()
    lines[3] = lines[3].replace("10.056667 ", "10.256667 ", 1)
    (folder / "rgb.txt").write_text("\n".join(lines))
    sequences, _ = open_kind("rgbd_folder", tmp_path, {"tolerance": 0.3, "max_gap": 0.15})
    assert [len(sequence) for sequence in sequences] == [2, 1]
    (sequence,), report = open_kind("rgbd_folder", tmp_path, {})
    assert len(sequence) == 2
    assert "1 x image without depth within 0.02 s (" in report.summary()


def test_unregistered_depth_is_refused(tmp_path: Path) -> None:
    make_plain(tmp_path)
    write_png(tmp_path / "depth" / "9.png", np.ones((48, 48), np.uint16))
    (sequence,), _ = open_kind("rgbd_folder", tmp_path, {})
    with pytest.raises(ValueError, match=r"9.png: depth of \(48, 48\) is not registered"):
        sequence.read(1)


def test_more_missing_frames_than_allowed_are_a_cut(tmp_path: Path) -> None:
    make_plain(tmp_path)
    for number in (12, 15):
        for folder, suffix in (("rgb", "jpg"), ("depth", "png")):
            data = (tmp_path / folder / f"8.{suffix}").read_bytes()
            (tmp_path / folder / f"{number}.{suffix}").write_bytes(data)
    (tmp_path / "poses.txt").unlink()
    for allowed, lengths in ((0, [3, 1, 1]), (1, [4, 1]), (2, [5])):
        sequences, _ = open_kind("rgbd_folder", tmp_path, {"max_missing": allowed})
        assert [len(sequence) for sequence in sequences] == lengths


def made_sequence(name: str, numbers: list[int], broken: tuple[int, ...] = ()) -> NumberedSequence:
    def reader(number: int) -> RgbdFrame:
        if number in broken:
            raise FrameError(f"{name}/{number}.png: damaged")
        shown = view(number % 5, SIZE, CAMERA)
        camera = (np.array(CAMERA) / [64, 48, 64, 48]).astype(np.float32)
        image = np.full_like(shown.image, number)
        return RgbdFrame(image, shown.depth.astype(np.float32), camera, shown.pose)

    return NumberedSequence(name, numbers, reader)


def clip_source(length: int, strides: tuple[int, int], *specs: DataSpec) -> ClipSource:
    stages = (SizeStage(0, ((32, 64),), 4),)
    return ClipSource(specs, ("clip",), length, strides, stages, augment_strength=0.0)


def test_clip_has_equal_strides_from_the_range_within_one_sequence() -> None:
    source = clip_source(4, (1, 5))
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(40):
        clip = draw_clip(source, made_sequence("a", list(range(20))), (32, 64), rng)
        steps = np.diff(clip.images[:, 16, 32, 0].astype(int))
        assert len(set(steps.tolist())) == 1
        seen.add(int(steps[0]))
    assert seen == {-5, -4, -3, -2, -1, 1, 2, 3, 4, 5}


def test_clip_knows_its_masks_points_and_poses_under_one_augmentation() -> None:
    """Cropped, mirrored and resized, the floor's points are still on the floor."""
    source = clip_source(3, (1, 1))
    sky = 0
    for seed in range(5):
        rng = np.random.default_rng(seed)
        clip = draw_clip(source, made_sequence("a", [0, 1, 2]), (32, 64), rng)
        assert clip.name == "a"
        sky += int(clip.infinite.sum())
        np.testing.assert_array_equal(clip.infinite, np.isposinf(clip.depth))
        np.testing.assert_array_equal(clip.valid, np.isfinite(clip.depth))
        assert clip.poses is not None
        points = clip.points()
        assert np.isnan(points[~clip.valid]).all()
        for index in range(3):
            turn, move = clip.poses[index, :3, :3], clip.poses[index, :3, 3]
            assert np.linalg.det(turn) == pytest.approx(1)
            world = points[index][clip.valid[index]] @ turn.T + move
            on_floor = np.abs(world[:, 1] - FLOOR)
            balls = [np.linalg.norm(world - BALL * [side, 1, 1], axis=-1) for side in (1, -1)]
            error = np.minimum(on_floor, np.min(np.abs(np.array(balls) - RADIUS), 0))
            distance = np.linalg.norm(points[index][clip.valid[index]], axis=-1)
            assert np.quantile(error / distance, 0.99) < 0.011  # half a pixel
    assert sky > 0


def test_cuts_split_sequences_and_unknown_ones_are_named() -> None:
    sequences = [made_sequence("x/P000", [0, 1, 2, 3, 4]), made_sequence("x/P001", [0, 1, 2])]
    pieces = cut_sequences(sequences, ["P000:3", "P001:1"])
    assert [list(piece.numbers) for piece in pieces] == [[0, 1, 2], [3, 4], [0], [1, 2]]  # type: ignore[attr-defined]
    with pytest.raises(DataError, match=r"cuts \['P002:1'\] are at no frame of 2 sequences"):
        cut_sequences(sequences, ["P002:1"])


def test_weights_are_shares_of_the_draws_and_frames_are_without(tmp_path: Path) -> None:
    make_plain(tmp_path / "a")
    make_point_odyssey(tmp_path / "b")
    two = (DataSpec(tmp_path / "a"), DataSpec(tmp_path / "b", "point_odyssey"))
    np.testing.assert_allclose(open_pool(two, "train").shares, [0.5, 0.5])
    weighted = (replace(two[0], weight=3.0), replace(two[1], weight=1.0))
    np.testing.assert_allclose(open_pool(weighted, "train").shares, [0.75, 0.25])
    with pytest.raises(DataError, match="give every data set a weight, or none"):
        open_pool((two[0], weighted[1]), "train")


def test_data_sets_mix_with_rendered_folders_and_splits(tmp_path: Path) -> None:
    write_data_set(tmp_path / "rendered")
    make_plain(tmp_path / "mine")
    specs = (DataSpec(tmp_path / "rendered"), DataSpec(tmp_path / "mine", split="held_out"))
    assert len(open_pool(specs, "train", 2).sequences) == 1
    held_out = open_pool(specs, "held_out", 2)
    assert len(held_out.sequences) == 2
    short = open_pool(specs, "held_out", 5)
    assert len(short.sequences) == 1
    assert "1 x sequence of fewer than 5 frames" in short.reports[1].summary()


def test_unreadable_clips_are_replaced_and_named_and_too_many_end_the_run() -> None:
    good, bad = made_sequence("good", [0, 1]), made_sequence("bad", [0, 1], broken=(1,))
    source = clip_source(2, (1, 1))
    unreadable: list[str] = []
    pool = DataPool([good, bad], np.array([0.5, 0.5]), [])
    batches = [draw_batch(source, pool, index, unreadable) for index in range(4)]
    assert all(batch.image.shape == (4, 2, 3, 32, 64) for batch in batches)
    assert set(unreadable) == {"bad/1.png: damaged"}
    again: list[str] = []
    assert (draw_batch(source, pool, 0, again).image == batches[0].image).all()
    with pytest.raises(DataError, match=r"50 clips in a row cannot be read, the last: bad/1.png"):
        draw_batch(source, DataPool([bad], np.ones(1), []), 0)


def test_data_that_cannot_be_read_end_a_loader_with_the_reason_and_are_counted(
    tmp_path: Path,
) -> None:
    make_plain(tmp_path)
    counted: Counter[str] = Counter()
    for depth in (tmp_path / "depth").iterdir():
        depth.write_bytes(b"damaged")
    loader = BatchLoader(clip_source(2, (1, 1), DataSpec(tmp_path)), unreadable=counted)
    with pytest.raises(DataError, match=r"^50 clips in a row cannot be read, the last: .*png"):
        next(loader)
    assert counted.total() == 50


def test_sequences_that_are_too_short_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make_plain(tmp_path / "mine")
    write_data_set(tmp_path / "rendered")
    specs = (DataSpec(tmp_path / "rendered"), DataSpec(tmp_path / "mine", split="held_out"))
    open_pool(specs, "held_out", 5)
    assert "1 x sequence of fewer than 5 frames" in caplog.text


def test_a_batch_from_a_folder_trains_like_one_from_rendered_clips(tmp_path: Path) -> None:
    make_plain(tmp_path)
    source = clip_source(2, (1, 2), DataSpec(tmp_path))
    batch = draw_batch(source, find_sequences(source, "train"), 0)
    assert batch.image.shape == (4, 2, 3, 32, 64)
    assert batch.depth.shape == (4, 2, 16, 32)
    assert batch.intrinsics.shape == (4, 2, 4)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("{root: a, kind: tartanare}", "unknown kind 'tartanare', did you mean 'tartanair'"),
        ("{root: a, kind: spring, wieght: 2}", "unknown key 'wieght' of kind 'spring', did you"),
        ("{root: a, depth_topic: /d}", "options need the `kind` to be named"),
        ("{root: a, kind: rgbd_folder, tolerance: soon}", "tolerance: Input should be a valid num"),
        ("{root: a, weight: -1}", "greater than 0"),
        ("{root: a, split: test}", "split must be one of"),
        ("{kind: irs}", "key 'data.0.root' is missing"),
    ],
)
def test_wrong_data_in_a_config_is_named(data: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(
        f"data: [{data}]\nsteps: 1\nstages: [{{from_step: 0, batch: 1, sizes: [[32, 32]]}}]"
    )
    with pytest.raises(ConfigError, match=message):
        read_config(path, BaseRunConfig, [])


def test_data_in_a_config_become_specs(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(
        "data: [here, {root: there, kind: rgbd_folder, weight: 2, cuts: [7], "
        "intrinsics: [1, 2, 3, 4]}]\n"
        "steps: 1\nstages: [{from_step: 0, batch: 1, sizes: [[32, 32]]}]"
    )
    here, there = (data.spec() for data in read_config(path, BaseRunConfig, []).data)
    assert here == DataSpec(Path("here"))
    options = (("intrinsics", (1.0, 2.0, 3.0, 4.0)),)
    assert there == DataSpec(Path("there"), "rgbd_folder", 2.0, None, (7,), options)


def test_a_path_of_no_known_kind_says_what_would_be(tmp_path: Path) -> None:
    (tmp_path / "holiday.txt").touch()
    with pytest.raises(DataError, match=r"rgbd_folder \(.*found holiday.txt"):
        open_pool((DataSpec(tmp_path),), "train")


def test_unreadable_frames_are_left_out_of_validation() -> None:
    good, bad = made_sequence("good", [0, 1]), made_sequence("bad", [0, 1], broken=(0, 1))
    assert len(spread_examples([good, bad], 4)) == 2
    with pytest.raises(FrameError, match=r"bad/1.png: damaged"):
        spread_examples([bad], 4)
