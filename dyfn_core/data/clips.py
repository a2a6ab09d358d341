"""Random training batches out of rendered folders: single frames, and clips for DyFN."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset

from dyfn_core.data.augment import apply_look, apply_view, draw_look, draw_view
from dyfn_core.data.rendered import Shard, list_shards


@dataclass(frozen=True)
class SizeStage:
    """From this step on: batches of `batch` clips at one of `sizes` (H, W), multiples of 32."""

    from_step: int
    sizes: tuple[tuple[int, int], ...]
    batch: int


@dataclass(frozen=True)
class ClipSource:
    """Where clips are drawn from, and how.

    roots: rendered folders. kinds: "frames" and/or "clip". length: frames of a clip, all from one
    shard; 1 for single frames. strides: smallest and largest step between them. relist_seconds:
    how often folders that are still growing are listed again.
    """

    roots: tuple[Path, ...]
    kinds: tuple[str, ...]
    length: int
    strides: tuple[int, int]
    stages: tuple[SizeStage, ...]
    augment_strength: float = 1.0
    smallest_view: float = 0.5
    depth_divisor: int = 2
    seed: int = 0
    relist_seconds: float = 120.0


@dataclass(frozen=True)
class ClipBatch:
    """image: B x T x 3 x H x W uint8. depth: B x T x h x w metres, inf sky, NaN invalid.
    intrinsics: B x T x 4 normalised fx, fy, cx, cy."""

    image: Tensor
    depth: Tensor
    intrinsics: Tensor


class ClipBatches(IterableDataset[ClipBatch]):
    """An endless stream of batches; the n-th depends on the seed, n and the folders alone."""

    def __init__(self, source: ClipSource, start: int = 0, split: str = "train") -> None:
        super().__init__()
        self.source, self.start, self.split = source, start, split

    def __iter__(self) -> Iterator[ClipBatch]:
        index, listed, shards = self.start, -np.inf, []
        while True:
            if time.monotonic() - listed > self.source.relist_seconds:
                shards = find_shards(self.source, self.split)
                listed = time.monotonic()
            yield draw_batch(self.source, shards, index)
            index += 1


def find_shards(source: ClipSource, split: str) -> list[Shard]:
    """Every finished shard that holds a clip. Raises FileNotFoundError when there is none."""
    span = (source.length - 1) * source.strides[0] + 1
    shards = [
        shard
        for root in source.roots
        for kind in source.kinds
        for shard in list_shards(root, kind, split)
        if len(shard) >= span
    ]
    if not shards:
        raise FileNotFoundError(
            f"no finished {' or '.join(source.kinds)} folder of split {split!r} with {span} "
            f"frames or more under {', '.join(str(root) for root in source.roots)}"
        )
    return shards


def batch_loader(source: ClipSource, start: int = 0) -> Iterator[ClipBatch]:
    """Batches from step `start` on, made by one background process."""
    loader = DataLoader(
        ClipBatches(source, start), batch_size=None, num_workers=1, prefetch_factor=6
    )
    return iter(loader)


def draw_batch(source: ClipSource, shards: list[Shard], index: int) -> ClipBatch:
    """The batch of step `index`: every clip of it augmented by one draw."""
    rng = np.random.default_rng([source.seed, index])
    stage = [stage for stage in source.stages if stage.from_step <= index][-1]
    size = stage.sizes[rng.integers(len(stage.sizes))]
    counts = np.array([len(shard) for shard in shards], np.float64)
    chosen = rng.choice(len(shards), stage.batch, p=counts / counts.sum())
    clips = [draw_clip(source, shards[number], size, rng) for number in chosen]
    image, depth, intrinsics = (np.stack(parts) for parts in zip(*clips, strict=True))
    return ClipBatch(
        torch.from_numpy(image.transpose(0, 1, 4, 2, 3)),
        torch.from_numpy(depth),
        torch.from_numpy(intrinsics),
    )


def draw_clip(
    source: ClipSource, shard: Shard, size: tuple[int, int], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One augmented clip: T x H x W x 3 uint8, T x h x w float32 depth, T x 4 intrinsics."""
    largest = source.strides[1]
    if source.length > 1:
        largest = min(largest, (len(shard) - 1) // (source.length - 1))
    stride = int(rng.integers(source.strides[0], largest + 1))
    first = int(rng.integers(len(shard) - (source.length - 1) * stride))
    indices = first + stride * np.arange(source.length)
    if source.length > 1 and rng.random() < 0.5:
        indices = indices[::-1]
    depth_size = (size[0] // source.depth_divisor, size[1] // source.depth_divisor)
    view, look = None, draw_look(rng, source.augment_strength)
    frames = []
    for number, index in enumerate(indices):
        image, depth = shard.read(int(index))
        if view is None:
            aspect = image.shape[1] / image.shape[0]
            view = draw_view(rng, aspect, size[1] / size[0], source.smallest_view)
        image, depth, intrinsics = apply_view(
            image, depth, shard.intrinsics[index], view, size, depth_size
        )
        frames.append((apply_look(image, look, number), depth, intrinsics))
    images, depths, cameras = (np.stack(parts) for parts in zip(*frames, strict=True))
    return images, depths, cameras
