"""What DyFN's recurrence needs of a clip, and no more: its inputs, scale errors, samples of depth.

With a frozen base, everything that decides a frame's scale is known before DyFN runs: the latent,
the base's own depth and its scale error, and how that error moves with the latent's statistics. A
clip shrinks from megabytes to kilobytes a frame, and a step of training needs no decoder.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from dyfn_core.data.clips import ClipBatch, ClipSource
from dyfn_core.models.base import AffineDisparity, GeometryModel, Latent
from dyfn_core.training.config import ConfigError
from dyfn_core.training.tasks.latent_cache import CacheFolder, encode_clips, fingerprint

FEWEST_PIXELS = 64  # frames with fewer valid ones have no scale error
TOGETHER = 8  # frames whose decoder is differentiated at once
FORMER = {"summary": "gru_input"}  # names in the files of an earlier version
FORMER_CONTENTS = {"contents": ["summary", "error", "depth", "truth", "slope"]}
GRID = (6, 8)  # samples of a frame's depth, evenly spread


@dataclass(frozen=True)
class GRUInputClips:
    """B clips of T frames.

    Attributes:
        gru_input: B x T x C (x h x w) float16, as DyFN.gru_input gives it.
        error: B x T, mean of log z - log(z* / focal) over the valid pixels, NaN without any.
        depth: B x T x N, the base's z at N pixels.
        truth: B x T x N, the true z at the same pixels, NaN where unknown.
        slope: B x T x 2C float16, derivative of a frame's error by DyFN's residual gamma and beta:
            its direction is nearly the same everywhere, its length is not.
    """

    gru_input: Tensor
    error: Tensor
    depth: Tensor
    truth: Tensor
    slope: Tensor

    def to(self, device: torch.device | str) -> GRUInputClips:
        """The same on another device."""
        return GRUInputClips(*(getattr(self, field.name).to(device) for field in fields(self)))


class GRUInputCache:
    """`draws` clips in a folder (CacheFolder), made once and kept in memory.

    unreadable: counts what could not be read while they were made. Raises ConfigError when the
    folder was made with another model, source or recurrence.
    """

    def __init__(
        self,
        folder: Path,
        model: GeometryModel,
        source: ClipSource,
        draws: int,
        unreadable: Counter[str],
    ) -> None:
        assert model.stabilizer is not None
        wanted = fingerprint(model, source)
        wanted["recurrence"] = [model.stabilizer.config.kind, model.stabilizer.config.pool]
        wanted["contents"] = [field.name for field in fields(GRUInputClips)]
        files = CacheFolder(folder, draws, wanted, "GRU inputs", FORMER_CONTENTS)
        files.build(source, partial(gru_inputs, model), unreadable)
        parts = [_renamed(part) for part in files.load()]
        self.clips = GRUInputClips(
            *(torch.cat([part[name] for part in parts]) for name in wanted["contents"])
        )

    def usual(self) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of every channel of the input over all clips, C each."""
        channels = self.clips.gru_input.transpose(0, 2).flatten(1).float()
        return channels.mean(1), channels.std(1).clamp(min=1e-6)

    def batches(
        self, start: int, seed: int, clips: int, length: int, strides: tuple[int, int]
    ) -> Iterator[GRUInputClips]:
        """Draw endless batches, on the CPU.

        Args:
            start: Step of the first batch.
            seed: Of the draws.
            clips: Clips of a batch.
            length: Frames of a clip, in order or backwards.
            strides: Least and greatest distance of the frames.

        Yields:
            A batch.
        """
        step = start
        frames = self.clips.gru_input.shape[1]
        longest = min(strides[1], (frames - 1) // (length - 1))
        while True:
            draw = torch.Generator().manual_seed(seed * 1_000_003 + step)
            chosen = [self._sub_clip(length, (strides[0], longest), draw) for _ in range(clips)]
            yield GRUInputClips(*(torch.stack(parts) for parts in zip(*chosen, strict=True)))
            step += 1

    def _sub_clip(
        self, length: int, strides: tuple[int, int], draw: torch.Generator
    ) -> tuple[Tensor, ...]:
        def below(limit: int) -> int:
            return int(torch.randint(limit, (1,), generator=draw))

        clip, frames = below(len(self.clips.gru_input)), self.clips.gru_input.shape[1]
        stride = strides[0] + below(strides[1] - strides[0] + 1)
        index = below(frames - (length - 1) * stride) + stride * torch.arange(length)
        if below(2):
            index = index.flip(0)
        return tuple(getattr(self.clips, field.name)[clip, index] for field in fields(self.clips))


def _renamed(part: dict[str, Tensor]) -> dict[str, Tensor]:
    """What a file of an earlier version calls summary is the GRU's input."""
    return {FORMER.get(name, name): value for name, value in part.items()}


def gru_inputs(model: GeometryModel, batch: ClipBatch) -> dict[str, Tensor]:
    """The parts of GRUInputClips."""
    dyfn = model.stabilizer
    assert dyfn is not None
    clips = encode_clips(model, batch)
    aspect = clips.image_size[1] / clips.image_size[0]
    half = (clips.image_size[0] // 2, clips.image_size[1] // 2)
    inputs, errors, slopes, depths, truths = [], [], [], [], []
    for latent, depth, intrinsics in zip(
        clips.latent.float(), clips.depth.float(), batch.intrinsics, strict=True
    ):
        with torch.no_grad():
            inputs.append(dyfn.gru_input(latent, latent.mean((-2, -1))).half())
        parts = [
            decoded_with_slope(model, Latent(some, half, clips.network_size), known)
            for some, known in zip(latent.split(TOGETHER), depth.split(TOGETHER), strict=True)
        ]
        z, level, slope = (torch.cat(part) for part in zip(*parts, strict=True))
        focal = 0.5 * (intrinsics[:, 0] * aspect + intrinsics[:, 1]) / (aspect**2 + 1) ** 0.5
        valid = torch.isfinite(depth) & (depth > 0)
        truth = torch.where(valid, depth, 1.0).log().sum((1, 2)) / valid.sum((1, 2)).clamp(min=1)
        seen = valid.sum((1, 2)) >= FEWEST_PIXELS
        errors.append(torch.where(seen, level - truth + focal.log(), torch.nan))
        depths.append(samples(z))
        truths.append(samples(torch.where(valid, depth, torch.nan)))
        slopes.append(slope.half())
    return {
        "gru_input": torch.stack(inputs).contiguous(),
        "error": torch.stack(errors),
        "depth": torch.stack(depths),
        "truth": torch.stack(truths),
        "slope": torch.stack(slopes),
    }


def decoded_z(model: GeometryModel, latent: Latent) -> Tensor:
    """B x h x w, positive. Raises ConfigError for a base of disparity."""
    affine = model.decode(latent)
    if isinstance(affine, AffineDisparity):
        raise ConfigError("the scale of a base of disparity is not a scale of depth")
    return affine.values.clamp(min=1e-6)


def mean_log(z: Tensor, depth: Tensor) -> Tensor:
    """B: mean of log z (B x h x w) over the pixels where depth is valid, else over all."""
    valid = torch.isfinite(depth) & (depth > 0)
    valid = valid | (valid.sum((1, 2), keepdim=True) == 0)
    return torch.where(valid, z.log(), 0.0).sum((1, 2)) / valid.sum((1, 2))


def samples(image: Tensor) -> Tensor:
    """B x h x w -> B x N, the pixels in the middle of GRID's cells."""
    rows, columns = (
        ((torch.arange(cells) + 0.5) * size / cells).long()
        for cells, size in zip(GRID, image.shape[1:], strict=True)
    )
    return image[:, rows[:, None], columns[None]].flatten(1).contiguous()


def decoded_with_slope(
    model: GeometryModel, latent: Latent, depth: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """One pass of the decoder, and back.

    Args:
        model: The base and its DyFN.
        latent: Of B frames.
        depth: B x h x w, the true one; decides the pixels that count.

    Returns:
        z (B x h x w), its mean_log (B), and the derivative of that by each frame's residual gamma
        and beta, at zero (B x 2C).
    """
    features = latent.features
    std, mean = torch.std_mean(features, dim=(-2, -1), keepdim=True)
    change = features.new_zeros(len(features), 2 * features.shape[1], 1, 1, requires_grad=True)
    with torch.enable_grad():
        gamma, beta = change.chunk(2, dim=1)
        moved = gamma.exp() * (features - mean) + mean + std * beta
        z = decoded_z(model, Latent(moved, latent.image_size, latent.network_size))
        level = mean_log(z, depth)
        (slope,) = torch.autograd.grad(level.sum(), change)
    return z.detach(), level.detach(), slope.flatten(1)
