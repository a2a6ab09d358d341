"""The frozen-latent cache: augmented clips, encoded once, for training what follows the encoder."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from tqdm import tqdm

from dyfn_core.data.clips import ClipBatch, ClipSource, batch_loader
from dyfn_core.files import finished_file, write_text
from dyfn_core.models.base import GeometryModel
from dyfn_core.training.config import ConfigError
from dyfn_core.training.loop.processes import own_place, wait_for_every_process

META = "cache.json"


@dataclass(frozen=True)
class LatentClips:
    """B clips of T frames: latent B x T x C x h x w and depth B x T x H x W (inf sky, NaN
    invalid) in float16, normalised intrinsics B x T x 4, image_size (H, W) of the clip and
    network_size that the latents were computed at."""

    latent: Tensor
    depth: Tensor
    intrinsics: Tensor
    image_size: tuple[int, int]
    network_size: tuple[int, int]

    def __len__(self) -> int:
        return len(self.latent)


@torch.no_grad()
def encode_clips(model: GeometryModel, batch: ClipBatch) -> LatentClips:
    """Every frame of every clip through the frozen encoder, one clip at a time."""
    size = (batch.image.shape[-2], batch.image.shape[-1])
    tokens = batch.tokens or max(1, round(size[0] * size[1] / model.token_cell**2))
    latents = [model.encode(clip.to(model.device).float() / 255, tokens) for clip in batch.image]
    return LatentClips(
        torch.stack([latent.features.half().cpu() for latent in latents]).contiguous(),
        batch.depth.half(),
        batch.intrinsics,
        size,
        latents[0].network_size,
    )


class CacheFolder:
    """`draws` numbered files of tensors in a folder, each made from one batch of clips.

    The folder says what it was made with (wanted); a folder made with something else is an error,
    not a surprise. An interrupted build goes on where it stopped; one that made no file, such as
    one of data that could not be opened, binds nobody. holds: what the files are, for messages.
    former: what an earlier version wrote for the same, by key of wanted.
    """

    def __init__(
        self,
        folder: Path,
        draws: int,
        wanted: dict[str, Any],
        holds: str,
        former: Mapping[str, Any] | None = None,
    ) -> None:
        self.folder, self.draws, self.holds = folder, draws, holds
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / META
        if next(folder.glob("*.safetensors"), None) is None:
            write_text(path, json.dumps(wanted, indent=1))
        try:
            found = dict(json.loads(path.read_text()))
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path} does not tell how {holds} were made: {error}") from error
        also = former or {}
        other = sorted(
            key
            for key in wanted
            if found.get(key) != wanted[key] and (key not in also or found.get(key) != also[key])
        )
        if other:
            raise ConfigError(
                f"{folder} holds {holds} made with another {', '.join(other)}: "
                "delete it or give another `method.cache`"
            )

    def build(
        self,
        source: ClipSource,
        make: Callable[[ClipBatch], dict[str, Tensor]],
        unreadable: Counter[str],
    ) -> None:
        """Make the files that are missing, each whole or not at all; counts as BatchLoader does.

        Each process of the run makes its share. Where the folder is not on a disk that all of
        them see, each then makes what it does not find.
        """
        process, count = own_place()
        share = range(process * self.draws // count, (process + 1) * self.draws // count)
        self._make_missing(share, source, make, unreadable)
        wait_for_every_process()
        self._make_missing(range(self.draws), source, make, unreadable)

    def _make_missing(
        self,
        share: range,
        source: ClipSource,
        make: Callable[[ClipBatch], dict[str, Tensor]],
        unreadable: Counter[str],
    ) -> None:
        missing = [index for index in share if not self._path(index).exists()]
        if not missing:
            return
        batches = batch_loader(source, missing[0], unreadable)
        wanted = range(missing[0], share.stop)
        # Not rich's: that shows nothing in a log file until the minutes are over.
        for index in tqdm(wanted, desc=f"making {self.holds}", unit="batch"):
            batch = next(batches)
            if self._path(index).exists():
                continue
            with finished_file(self._path(index)) as partial:
                save_file(make(batch), partial)

    def load(self) -> list[dict[str, Tensor]]:
        """All files in order."""
        return [load_file(self._path(index)) for index in range(self.draws)]

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:05d}.safetensors"


class LatentCache:
    """`draws` batches of encoded clips in a folder (CacheFolder), made once and kept in memory.

    unreadable: counts what could not be read while they were made.
    """

    def __init__(
        self,
        folder: Path,
        model: GeometryModel,
        source: ClipSource,
        draws: int,
        unreadable: Counter[str],
    ) -> None:
        def make(batch: ClipBatch) -> dict[str, Tensor]:
            clips = encode_clips(model, batch)
            return {
                "latent": clips.latent,
                "depth": clips.depth,
                "intrinsics": clips.intrinsics,
                "image_size": torch.tensor(clips.image_size),
                "network_size": torch.tensor(clips.network_size),
            }

        files = CacheFolder(folder, draws, fingerprint(model, source), "latents")
        files.build(source, make, unreadable)
        self.entries = [_latent_clips(parts) for parts in files.load()]

    def batches(self, start: int, seed: int, clips: int, length: int) -> Iterator[LatentClips]:
        """Endless random batches of one size: sub-clips of `length`, as they were or reversed."""
        sizes = sorted({entry.image_size for entry in self.entries})
        groups = [[e for e in self.entries if e.image_size == size] for size in sizes]
        counts = torch.tensor([float(sum(map(len, group))) for group in groups])
        step = start
        while True:
            draw = torch.Generator().manual_seed(seed * 1_000_003 + step)
            group = groups[int(torch.multinomial(counts, 1, generator=draw))]
            chosen = [_sub_clip(group, length, draw) for _ in range(clips)]
            latent, depth, intrinsics = (torch.stack(parts) for parts in zip(*chosen, strict=True))
            yield LatentClips(latent, depth, intrinsics, group[0].image_size, group[0].network_size)
            step += 1


def _latent_clips(parts: dict[str, Tensor]) -> LatentClips:
    height, width = parts["image_size"].tolist()
    # Caches of `mini` from before other models had none: it works at the clip's size.
    rows, columns = parts.get("network_size", parts["image_size"]).tolist()
    return LatentClips(
        parts["latent"], parts["depth"], parts["intrinsics"], (height, width), (rows, columns)
    )


def _sub_clip(
    group: list[LatentClips], length: int, draw: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """A random run of frames, every one or every second, forwards or backwards."""

    def below(limit: int) -> int:
        return int(torch.randint(limit, (1,), generator=draw))

    entry = group[below(len(group))]
    clip, frames = below(len(entry)), entry.latent.shape[1]
    stride = 1 + below(2 if frames >= 2 * length - 1 else 1)
    first = below(frames - (length - 1) * stride)
    index = first + stride * torch.arange(length)
    if below(2):
        index = index.flip(0)
    return entry.latent[clip, index], entry.depth[clip, index], entry.intrinsics[clip, index]


def fingerprint(model: GeometryModel, source: ClipSource) -> dict[str, Any]:
    """What a cache depends on: the frozen parameters, and where its clips come from."""
    ignored = ("relist_seconds", "workers")
    described = {key: value for key, value in asdict(source).items() if key not in ignored}
    for values in (described, *described["stages"]):  # caches of earlier versions lack these
        for name in ("fov", "depth_clamp", "area", "aspect", "tokens"):
            if values.get(name, 0) is None:
                del values[name]
    described = json.loads(json.dumps(described, default=str))
    return {"model": base_digest(model), "source": described}


def base_digest(model: GeometryModel) -> str:
    """SHA-256 of all parameters but DyFN's."""
    digest = hashlib.sha256()
    for name, value in model.state_dict().items():
        if not name.startswith("stabilizer."):
            digest.update(value.detach().cpu().float().contiguous().numpy().tobytes())
    return digest.hexdigest()
