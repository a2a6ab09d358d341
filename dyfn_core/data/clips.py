"""Random training batches out of data sets: single frames, and clips for DyFN."""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from dyfn_core.data.augment import (
    apply_appearance,
    apply_crop,
    clamped,
    crop_widths,
    draw_appearance,
    draw_crop,
    mirrored_pose,
)
from dyfn_core.data.frames import DataError, FrameError, FrameSequence
from dyfn_core.data.pool import DataPool, DataSpec, open_pool

PREFETCHED = 6  # batches that a process makes ahead
MOST_UNREADABLE = 50  # clips in a row that cannot be read end a run
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SizeStage:
    """From this step on: batches of `batch` clips at one of `sizes` (H, W), multiples of 32; or,
    without sizes, at one of an area (pixels) and an aspect (width / height) drawn evenly from these
    ranges. tokens: range of the number of tokens of a vision transformer; None: the image's own."""

    from_step: int
    sizes: tuple[tuple[int, int], ...]
    batch: int
    area: tuple[int, int] | None = None
    aspect: tuple[float, float] | None = None
    tokens: tuple[int, int] | None = None

    def size(self, rng: np.random.Generator) -> tuple[int, int]:
        """Draw the size of a batch."""
        if self.area is None or self.aspect is None:
            return self.sizes[rng.integers(len(self.sizes))]
        area, aspect = rng.uniform(*self.area), float(np.exp(rng.uniform(*np.log(self.aspect))))
        return multiples(area, aspect)


def multiples(area: float, aspect: float) -> tuple[int, int]:
    """The height and width, multiples of 32, nearest to those of an area and an aspect."""
    height = (area / aspect) ** 0.5
    return max(32, 32 * round(height / 32)), max(32, 32 * round(height * aspect / 32))


@dataclass(frozen=True)
class ClipSource:
    """Where clips are drawn from, and how.

    data: the data sets. kinds: of rendered folders, "frames" and/or "clip". length: frames of a
    clip, all from one sequence; 1 for single frames. strides: smallest and largest step between
    them. relist_seconds: how often rendered folders that are still growing are listed again.
    fov: bounds of the horizontal field of view, degrees. depth_clamp: depth is at most that many
    times the depth that 1% of the pixels are nearer than. workers: processes that make batches.
    """

    data: tuple[DataSpec, ...]
    kinds: tuple[str, ...]
    length: int
    strides: tuple[int, int]
    stages: tuple[SizeStage, ...]
    augment_strength: float = 1.0
    smallest_view: float = 0.5
    depth_divisor: int = 2
    seed: int = 0
    relist_seconds: float = 120.0
    fov: tuple[float, float] | None = None
    depth_clamp: float | None = None
    workers: int = 1


@dataclass(frozen=True)
class Clip:
    """T frames of one camera in the order of time (or exactly reversed), equally spaced.

    images: T x H x W x 3 uint8 RGB. depth: T x h x w float32 metres along the optical axis, inf
    where nothing is hit, NaN where unknown. intrinsics: T x 4 normalised fx, fy, cx, cy. poses:
    T x 4 x 4 camera to world, optical axes, metres; None unless every frame has one. name: the
    sequence it is from.
    """

    images: np.ndarray
    depth: np.ndarray
    intrinsics: np.ndarray
    poses: np.ndarray | None
    name: str

    @property
    def valid(self) -> np.ndarray:
        """T x h x w bool: where the depth is known and finite."""
        result: np.ndarray = np.isfinite(self.depth) & (self.depth > 0)
        return result

    @property
    def infinite(self) -> np.ndarray:
        """T x h x w bool: where nothing is hit (sky)."""
        return np.isposinf(self.depth)

    def points(self) -> np.ndarray:
        """T x h x w x 3 float32 metres in each frame's optical axes, NaN where not valid."""
        height, width = self.depth.shape[1:]
        depth = np.where(self.valid, self.depth, np.nan)
        fx, fy, cx, cy = (self.intrinsics[:, k, None, None] for k in range(4))
        x = ((np.arange(width) + 0.5) / width - cx) / fx
        y = ((np.arange(height)[:, None] + 0.5) / height - cy) / fy
        return np.stack([x * depth, y * depth, depth], -1).astype(np.float32)


@dataclass(frozen=True)
class ClipBatch:
    """image: B x T x 3 x H x W uint8. depth: B x T x h x w metres, inf sky, NaN invalid.
    intrinsics: B x T x 4 normalised fx, fy, cx, cy. tokens: of an image; None: as many as it has
    cells."""

    image: Tensor
    depth: Tensor
    intrinsics: Tensor
    tokens: int | None = None


class ClipBatches(IterableDataset[tuple[ClipBatch | Exception, list[str]]]):
    """An endless stream of batches, each with what was drawn but could not be read.

    The n-th depends on the seed, n and the data alone: of N workers, each makes every N-th. What
    ends the stream comes in a batch's place: raised in another process, its message would be a
    traceback.
    """

    def __init__(self, source: ClipSource, start: int = 0, split: str = "train") -> None:
        super().__init__()
        self.source, self.start, self.split = source, start, split

    def __iter__(self) -> Iterator[tuple[ClipBatch | Exception, list[str]]]:
        worker = get_worker_info()
        first, step = (0, 1) if worker is None else (worker.id, worker.num_workers)
        index, listed, pool = self.start + first, -np.inf, None
        while True:
            unreadable: list[str] = []
            try:
                if pool is None or time.monotonic() - listed > self.source.relist_seconds:
                    pool = find_sequences(self.source, self.split)
                    listed = time.monotonic()
                batch = draw_batch(self.source, pool, index, unreadable)
            except (DataError, FileNotFoundError) as error:
                yield error, unreadable
                return
            yield batch, unreadable
            index += step


class BatchLoader:
    """Batches made by background processes, in order; what could not be read is logged and counted.

    unreadable: message -> how often it was drawn; a given Counter is added to.
    Raises DataError when too many clips in a row cannot be read.
    """

    def __init__(
        self, source: ClipSource, start: int = 0, unreadable: Counter[str] | None = None
    ) -> None:
        find_sequences(source, "train")  # opened here, so that the process inherits it
        loader = DataLoader(
            ClipBatches(source, start),
            batch_size=None,
            num_workers=source.workers,
            prefetch_factor=PREFETCHED,
            worker_init_fn=_leave_signals_to_the_run,
        )
        self._batches = iter(loader)
        self.unreadable: Counter[str] = Counter() if unreadable is None else unreadable

    def __iter__(self) -> BatchLoader:
        return self

    def __next__(self) -> ClipBatch:
        batch: ClipBatch | Exception
        batch, unreadable = next(self._batches)
        for message in unreadable:
            if message not in self.unreadable:
                logger.warning("another clip was drawn instead: %s", message)
            self.unreadable[message] += 1
        if isinstance(batch, Exception):
            raise batch
        return batch


def _leave_signals_to_the_run(worker: int) -> None:
    """Out of the process group, so that Ctrl-C reaches the run alone, which then stops in order."""
    os.setpgid(0, 0)


def find_sequences(source: ClipSource, split: str) -> DataPool:
    """Every sequence that holds a clip. Raises FileNotFoundError when there is none."""
    span = (source.length - 1) * source.strides[0] + 1
    return open_pool(source.data, split, span, source.kinds)


def batch_loader(
    source: ClipSource, start: int = 0, unreadable: Counter[str] | None = None
) -> BatchLoader:
    """Batches from step `start` on; see BatchLoader."""
    return BatchLoader(source, start, unreadable)


def draw_batch(
    source: ClipSource, pool: DataPool, index: int, unreadable: list[str] | None = None
) -> ClipBatch:
    """The batch of step `index`: every clip of it augmented by one draw.

    A clip that cannot be read is replaced by another; what was wrong is appended to `unreadable`.
    Raises DataError when MOST_UNREADABLE clips in a row cannot be read.
    """
    rng = np.random.default_rng([source.seed, index])
    stage = [stage for stage in source.stages if stage.from_step <= index][-1]
    size = stage.size(rng)
    chosen = rng.choice(len(pool.sequences), stage.batch, p=pool.shares)
    unreadable = [] if unreadable is None else unreadable
    clips = [_readable_clip(source, pool, int(n), size, rng, unreadable) for n in chosen]
    return ClipBatch(
        torch.from_numpy(np.stack([clip.images for clip in clips]).transpose(0, 1, 4, 2, 3)),
        torch.from_numpy(np.stack([clip.depth for clip in clips])),
        torch.from_numpy(np.stack([clip.intrinsics for clip in clips])),
        None if stage.tokens is None else int(rng.integers(stage.tokens[0], stage.tokens[1] + 1)),
    )


def _readable_clip(
    source: ClipSource,
    pool: DataPool,
    number: int,
    size: tuple[int, int],
    rng: np.random.Generator,
    unreadable: list[str],
) -> Clip:
    """A clip of sequence `number`; of others drawn in its place while frames are unreadable."""
    for _ in range(MOST_UNREADABLE):
        try:
            return draw_clip(source, pool.sequences[number], size, rng)
        except FrameError as error:
            unreadable.append(str(error))
            number = int(rng.choice(len(pool.sequences), p=pool.shares))
    raise DataError(f"{MOST_UNREADABLE} clips in a row cannot be read, the last: {unreadable[-1]}")


def draw_clip(
    source: ClipSource, sequence: FrameSequence, size: tuple[int, int], rng: np.random.Generator
) -> Clip:
    """One augmented clip. Raises FrameError when a frame cannot be read."""
    largest = source.strides[1]
    if source.length > 1:
        largest = min(largest, (len(sequence) - 1) // (source.length - 1))
    stride = int(rng.integers(source.strides[0], largest + 1))
    first = int(rng.integers(len(sequence) - (source.length - 1) * stride))
    indices = first + stride * np.arange(source.length)
    if source.length > 1 and rng.random() < 0.5:
        indices = indices[::-1]
    depth_size = (size[0] // source.depth_divisor, size[1] // source.depth_divisor)
    view, look = None, draw_appearance(rng, source.augment_strength)
    frames, poses = [], []
    for number, index in enumerate(indices):
        frame = sequence.read(int(index))
        if view is None:
            aspect = frame.image.shape[1] / frame.image.shape[0]
            widths = crop_widths(source.fov, float(frame.intrinsics[0]))
            view = draw_crop(rng, aspect, size[1] / size[0], source.smallest_view, widths)
        image, depth, intrinsics = apply_crop(
            frame.image, frame.depth, frame.intrinsics, view, size, depth_size
        )
        if source.depth_clamp is not None:
            depth = clamped(depth, source.depth_clamp)
        frames.append((apply_appearance(image, look, number), depth, intrinsics))
        if frame.pose is not None:
            poses.append(mirrored_pose(frame.pose) if view.flip else frame.pose)
    images, depths, cameras = (np.stack(parts) for parts in zip(*frames, strict=True))
    placed = np.stack(poses) if len(poses) == len(frames) else None
    return Clip(images, depths, cameras, placed, sequence.name)
