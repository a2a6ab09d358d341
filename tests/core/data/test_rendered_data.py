"""Reading rendered folders, augmenting them, and drawing batches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dyfn_core.data.augment import apply_appearance, apply_crop, draw_appearance, draw_crop
from dyfn_core.data.clips import ClipSource, SizeStage, draw_batch, find_sequences
from dyfn_core.data.pool import DataSpec
from dyfn_core.data.rendered import decode_depth, encode_depth, list_shards, read_shard
from tests.support.made_frames import INTRINSICS, SIZE, made_frame, write_data_set, write_shard


def source(root: Path, **changes: object) -> ClipSource:
    plain = ClipSource(
        data=(DataSpec(root),),
        kinds=("frames", "clip"),
        length=1,
        strides=(1, 1),
        stages=(SizeStage(0, ((64, 96),), 3), SizeStage(5, ((96, 64),), 2)),
    )
    return replace(plain, **changes)


def test_depth_survives_storage_to_half_a_millimetre() -> None:
    depth = np.array([0.3, 1.0004, 65.534, 100.0, np.inf, np.nan], np.float32)
    stored = encode_depth(depth)
    assert stored.tolist() == [300, 1000, 65534, 65534, 65535, 0]
    back = decode_depth(stored)
    np.testing.assert_allclose(back[:3], depth[:3], atol=5.1e-4)
    assert np.isposinf(back[4])
    assert np.isnan(back[5])


def test_shard_reads_what_was_rendered(tmp_path: Path) -> None:
    shard = read_shard(write_shard(tmp_path, "a_0", "frames", "train", 2, seed=5))
    image, depth = made_frame(np.random.default_rng(5))
    frame = shard.read(0)
    read_image, read_depth = frame.image, frame.depth
    assert np.abs(read_image.astype(int) - image).mean() < 15  # red and blue swapped: over 50
    finite = np.isfinite(depth)
    np.testing.assert_allclose(read_depth[finite], depth[finite], atol=6e-4)
    assert np.isposinf(read_depth[~finite]).all()


def test_unfinished_and_other_shards_are_left_out(tmp_path: Path) -> None:
    write_data_set(tmp_path)
    (tmp_path / "frames" / "c_0").mkdir()
    assert [s.folder.name for s in list_shards(tmp_path, "frames", "train")] == ["a_0"]
    assert [s.folder.name for s in list_shards(tmp_path, "clip", "held_out")] == ["b_1"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"intrinsics": "no"}, "meta.json: not the description"),
        ({"kind": "movie"}, "kind 'movie'"),
        ({"poses": [np.eye(4).tolist()]}, "1 poses but 2 intrinsics"),
    ],
)
def test_bad_description_is_named(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    folder = write_shard(tmp_path, "a_0", "frames", "train", 2, changes=changes)
    with pytest.raises(ValueError, match=message):
        read_shard(folder)


def test_damaged_image_is_named(tmp_path: Path) -> None:
    shard = read_shard(write_shard(tmp_path, "a_0", "frames", "train", 2))
    (shard.folder / "00001.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"00001\.png"):
        shard.read(1)


@pytest.mark.parametrize("seed", range(6))
def test_points_stay_the_same_under_a_new_view(seed: int) -> None:
    """A pixel of the crop, unprojected with its new intrinsics, is a point of the old frame."""
    rng = np.random.default_rng(seed)
    image, depth = made_frame(rng)
    height, width = SIZE
    tag = (np.arange(height)[:, None] * width + np.arange(width)).astype(np.float32)
    view = draw_crop(rng, width / height, rng.uniform(0.7, 1.6))
    args = (np.array(INTRINSICS), view, (64, 64), (32, 32))
    _, tags, intrinsics = apply_crop(image, tag, *args)
    row, col = tags.astype(int) // width, tags.astype(int) % width
    fx, fy, cx, cy = INTRINSICS
    old = np.stack([((col + 0.5) / width - cx) / fx, ((row + 0.5) / height - cy) / fy])
    grid = (np.arange(32) + 0.5) / 32
    fx, fy, cx, cy = intrinsics
    new = np.stack(np.meshgrid((grid - cx) / fx, (grid - cy) / fy))
    if view.flip:
        old[0] = -old[0]
    pixel = 1 / (INTRINSICS[0] * width)
    assert np.abs(new - old).max() < 1.5 * pixel
    assert depth.shape == SIZE


def test_look_of_strength_zero_changes_nothing_and_of_one_does() -> None:
    image, _ = made_frame(np.random.default_rng(0))
    same = apply_appearance(image, draw_appearance(np.random.default_rng(1), 0.0))
    assert np.abs(same.astype(int) - image).max() <= 1
    changed = apply_appearance(image, draw_appearance(np.random.default_rng(1), 1.0))
    assert np.abs(changed.astype(int) - image).mean() > 3


def test_look_is_a_value_and_only_noise_differs_between_frames() -> None:
    image, _ = made_frame(np.random.default_rng(0))
    look = replace(draw_appearance(np.random.default_rng(3)), noise=(0.05, 0.02), jpeg=None)
    np.testing.assert_array_equal(
        apply_appearance(image, look, 1), apply_appearance(image, look, 1)
    )
    assert (apply_appearance(image, look, 1) != apply_appearance(image, look, 2)).any()
    silent = replace(look, noise=(0.0, 0.0))
    np.testing.assert_array_equal(
        apply_appearance(image, silent, 1), apply_appearance(image, silent, 2)
    )


def test_batch_depends_on_its_number_alone(tmp_path: Path) -> None:
    drawn = source(write_data_set(tmp_path))
    pool = find_sequences(drawn, "train")
    batch, again = draw_batch(drawn, pool, 3), draw_batch(drawn, pool, 3)
    assert batch.image.shape == (3, 1, 3, 64, 96)
    assert batch.depth.shape == (3, 1, 32, 48)
    assert bool((batch.image == again.image).all())
    assert bool((batch.image != draw_batch(drawn, pool, 4).image).any())
    assert draw_batch(drawn, pool, 5).image.shape == (2, 1, 3, 96, 64)


def test_clip_comes_from_one_shard_in_order_with_one_augmentation(tmp_path: Path) -> None:
    folder = write_shard(tmp_path, "a_0", "clip", "train", 9)
    first = (folder / "00000.jpg").read_bytes(), (folder / "00000.png").read_bytes()
    for index in range(1, 9):  # the same picture nine times
        (folder / f"{index:05d}.jpg").write_bytes(first[0])
        (folder / f"{index:05d}.png").write_bytes(first[1])
    drawn = source(tmp_path, kinds=("clip",), length=3, strides=(2, 8))
    pool = find_sequences(drawn, "train")
    for number in range(4):
        batch = draw_batch(drawn, pool, number)
        same = np.nan_to_num(batch.depth.numpy(), posinf=-1)
        np.testing.assert_array_equal(same, np.repeat(same[:, :1], 3, axis=1))
        difference = batch.image.float().diff(dim=1).abs().mean()
        assert float(difference) < 12  # sensor noise, and JPEG of it
        np.testing.assert_array_equal(batch.intrinsics[:, 0], batch.intrinsics[:, 2])


def test_data_without_a_long_enough_clip_is_an_error_that_says_so(tmp_path: Path) -> None:
    drawn = source(write_data_set(tmp_path), kinds=("clip",), length=6, strides=(3, 5))
    with pytest.raises(FileNotFoundError, match="no sequence of split 'train' with 16"):
        find_sequences(drawn, "train")
