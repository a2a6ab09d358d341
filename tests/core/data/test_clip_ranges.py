"""Ranges that clips are drawn from, and batches that any number of processes make alike."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from dyfn_core.data.augment import clamped, crop_widths, draw_crop
from dyfn_core.data.clips import ClipSource, SizeStage, batch_loader, draw_batch, find_sequences
from dyfn_core.data.pool import DataSpec
from tests.support.made_frames import write_shard


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("clips")
    write_shard(root, "a_1", "clip", "train", 8, seed=2)
    return root


def source(data: Path, **changes: object) -> ClipSource:
    stage = SizeStage(0, (), 1, area=(9000, 16000), aspect=(0.5, 2.0), tokens=(3, 9))
    return ClipSource((DataSpec(data),), ("clip",), 2, (1, 2), (stage,), **changes)  # type: ignore[arg-type]


def test_sizes_and_tokens_lie_in_their_ranges(data: Path) -> None:
    made = source(data)
    pool = find_sequences(made, "train")
    batches = [draw_batch(made, pool, n) for n in range(12)]
    sizes = [tuple(batch.image.shape[-2:]) for batch in batches]
    assert all(height % 32 == 0 and width % 32 == 0 for height, width in sizes)
    assert all(0.5 * 9000 <= height * width <= 1.6 * 16000 for height, width in sizes)
    assert len(set(sizes)) > 3
    tokens = {batch.tokens for batch in batches}
    assert tokens <= set(range(3, 10))
    assert len(tokens) > 2


@pytest.mark.slow
def test_batches_are_the_same_with_any_number_of_processes(data: Path) -> None:
    wanted = [batch for batch, _ in zip(batch_loader(source(data), 3), range(7), strict=False)]
    for workers in (2, 3):
        loader = batch_loader(source(data, workers=workers), 3)
        for ours, theirs in zip(wanted, loader, strict=False):
            assert torch.equal(ours.image, theirs.image)
            assert torch.equal(ours.depth, theirs.depth)
            assert ours.tokens == theirs.tokens


def test_a_field_of_view_bounds_the_crop() -> None:
    rng = np.random.default_rng(0)
    focal = 0.6  # 79.6 degrees
    for bounds in ((60.0, 70.0), (30.0, 40.0)):
        for _ in range(20):
            crop = draw_crop(rng, 1.5, 1.5, 0.5, crop_widths(bounds, focal))
            width = crop.window[2] - crop.window[0]
            angle = math.degrees(2 * math.atan(width / (2 * focal)))
            assert bounds[0] - 1e-6 <= angle <= bounds[1] + 1e-6
    whole = draw_crop(rng, 1.5, 1.5, 0.5, crop_widths((100.0, 150.0), focal))
    assert whole.window == (0, 0, 1, 1)  # the camera sees no more


def test_far_depth_is_clamped_and_the_unknown_stays() -> None:
    depth = np.full((10, 10), 2.0, np.float32)
    depth[0, :3] = [9000, np.nan, np.inf]
    found = clamped(depth, 1000)
    np.testing.assert_array_equal(found[0, :3], np.array([2000, np.nan, np.inf], np.float32))
    assert (found[1:] == 2).all()
    assert np.isnan(clamped(np.full((2, 2), np.nan, np.float32), 10)).all()
