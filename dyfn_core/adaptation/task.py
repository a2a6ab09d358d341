"""What `dyfn-train adapt` trains: DyFN and by option the decoder, on points of recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from dyfn_core.adaptation.config import AdaptConfig
from dyfn_core.adaptation.parts import Parts
from dyfn_core.adaptation.recording import SparseFrames
from dyfn_core.adaptation.scores import HeldBackScore, at_points, score_frames
from dyfn_core.losses.video_protocol import video_protocol_loss
from dyfn_core.models.base import GeometryModel, Latent
from dyfn_core.models.mini import MiniModel
from dyfn_core.prediction import DISPARITY, StreamState
from dyfn_core.training.config import ConfigError
from dyfn_core.training.loop.processes import full_precision, part_seed, share_of
from dyfn_core.training.tasks.pictures import coloured_depth
from dyfn_core.training.tasks.task import Task


@dataclass(frozen=True)
class SparseClips:
    """B clips of T frames: see SparseFrames, with B x T in the place of N."""

    latent: Tensor
    place: Tensor
    depth: Tensor
    weight: Tensor
    network_size: tuple[int, int]


class AdaptTask(Task):
    """A model on reduced recordings.

    The score is the error of the held-back points under one alignment for all frames of a
    recording, the mean over the recordings.

    Attributes:
        bundled: Each recording's scores before anything was learned.
        before: The score of that.
    """

    def __init__(
        self,
        config: AdaptConfig,
        model: GeometryModel,
        recordings: list[SparseFrames],
        parts: list[Parts],
    ) -> None:
        """Freeze what does not learn, and score the model as it is.

        Raises:
            ConfigError: The model has no DyFN, predicts disparity, or has no decoder part to
                learn; or no clip fits into what is learned from.
        """
        self.config, self.model = config, model
        self.recordings, self.parts = recordings, parts
        self._decoder = trained_parts(config, model)
        pairs = zip(recordings, parts, strict=True)
        self._places = [_places(frames, part, config) for frames, part in pairs]
        if not any(self._places):
            raise ConfigError(
                f"length: no run of {config.length} frames is learned from; give a shorter length, "
                "a higher rate or a longer recording"
            )
        model.eval()
        self.bundled = self.held_back(model)
        self.before = _mean([score.points_video for score in self.bundled])
        if not np.isfinite(self.before):
            raise ConfigError(f"base: {config.base} predicts nothing at the held-back points")

    def groups(self) -> list[dict[str, Any]]:
        rate, dyfn = self.config.learning_rate, self.model.stabilizer
        assert dyfn is not None  # trained_parts has looked
        groups: list[dict[str, Any]] = [{"params": list(dyfn.parameters()), "lr": rate}]
        if self._decoder:
            lower = rate * self.config.decoder_rate
            groups.append({"params": self._decoder, "lr": lower})
        return groups

    def held_back(self, model: GeometryModel) -> list[HeldBackScore]:
        """Scores of a model on each recording's held-back frames."""
        pairs = zip(self.recordings, self.parts, strict=True)
        return [score_frames(model, frames, part.held_back) for frames, part in pairs]

    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[SparseClips]:
        count = share_of(self.config.clips, parts, "clips")
        seed, step = part_seed(self.config.seed, part), start
        shares = torch.tensor([float(len(places)) for places in self._places])
        while True:
            draw = torch.Generator().manual_seed(seed * 1_000_003 + step)
            index = int(torch.multinomial(shares, 1, generator=draw))
            chosen = [_drawn(self._places[index], self.config.length, draw) for _ in range(count)]
            frames, rows = self.recordings[index], torch.stack(chosen)
            yield SparseClips(
                frames.latent[rows],
                frames.place[rows],
                frames.depth[rows],
                frames.weight[rows],
                frames.network_size,
            )
            step += 1

    def images(self, batch: SparseClips) -> int:
        return batch.latent.shape[0] * batch.latent.shape[1]

    def loss(self, batch: SparseClips) -> tuple[Tensor, dict[str, float]]:
        others = 1 + torch.randperm(batch.latent.shape[1] - 1)[: self.config.decoded - 1]
        seen = [0, *sorted(others.tolist())]
        z = self._z(batch, seen)
        with full_precision(z):
            predicted = at_points(z.flatten(0, 1).float(), batch.place[:, seen].flatten(0, 1))
            predicted = predicted.unflatten(0, z.shape[:2])
            depth, weight = batch.depth[:, seen], _each_frame_alike(batch.weight[:, seen])
            clip = video_protocol_loss(predicted, depth, weight)
            frame = video_protocol_loss(
                *(part.flatten(0, 1)[:, None] for part in (predicted, depth, weight))
            )
            total = clip + self.config.frame_weight * frame
        values = {"loss": total, "video": clip, "frame": frame}
        return total, {name: float(value.detach()) for name, value in values.items()}

    def _z(self, batch: SparseClips, seen: list[int]) -> Tensor:
        """Decoded z of some frames of each clip, B x S x H/2 x W/2; DyFN sees all of them."""
        half = (batch.network_size[0] // 2, batch.network_size[1] // 2)
        state: StreamState | None = None
        outputs = []
        with full_precision(batch.latent):
            for features in batch.latent.float().unbind(1):
                latent = Latent(features, half, batch.network_size)
                latent, state = self.model.stabilize_latent(latent, state)
                outputs.append(latent.features)
        kept = torch.stack([outputs[index] for index in seen], 1)
        affine = self.model.decode(Latent(kept.flatten(0, 1), half, batch.network_size))
        return torch.unflatten(affine.values, 0, kept.shape[:2])

    def validate(self) -> dict[str, float]:
        found = self.held_back(self.model)
        return {
            "score": _mean([score.points_video for score in found]),
            "before": self.before,
            "points_image": _mean([score.points_image for score in found]),
            "points_image_before": _mean([score.points_image for score in self.bundled]),
        }

    def picture(self, batch: SparseClips) -> np.ndarray:
        """Depth of the first clip's frames."""
        z = self._z(batch, list(range(batch.latent.shape[1])))[0].float().cpu().numpy()
        return coloured_depth(np.hstack(list(z)))


def trained_parts(config: AdaptConfig, model: GeometryModel) -> list[nn.Parameter]:
    """Let DyFN and the asked part of the decoder learn, and nothing else.

    Returns:
        The parameters of that part.

    Raises:
        ConfigError: The model has no such part.
    """
    if model.quantity == DISPARITY:
        raise ConfigError(f"base: {config.base} predicts disparity, expected a model of depth")
    if model.stabilizer is None:
        raise ConfigError(f"base: {config.base} has no DyFN to adapt")
    model.requires_grad_(False)
    model.stabilizer.requires_grad_(True)
    if config.decoder == "none":
        return []
    if not isinstance(model, MiniModel):
        raise ConfigError(
            f"decoder: only that of `mini` models can learn, not that of {config.base}: give none"
        )
    decoder = model.decoder
    chosen = [decoder.points, decoder.stages[-1], decoder.joins[-1]]
    whole: list[nn.Module] = [decoder] if config.decoder == "all" else chosen
    for module in whole:
        module.requires_grad_(True)
    decoder.mask.requires_grad_(False)  # nothing here says where depth is unknown
    return [p for p in decoder.parameters() if p.requires_grad]


def _places(frames: SparseFrames, parts: Parts, config: AdaptConfig) -> list[tuple[int, int]]:
    """First frame and stride of every clip in which at least half of the frames have points."""
    seen = frames.seen.tolist()
    return [
        (start, stride)
        for first, last in parts.runs
        for stride in range(1, config.most_stride + 1)
        for start in range(first, last - (config.length - 1) * stride + 1)
        if 2 * sum(seen[start : start + config.length * stride : stride]) >= config.length
    ]


def _drawn(places: list[tuple[int, int]], length: int, draw: torch.Generator) -> Tensor:
    """The frames of a random clip, forwards or backwards."""
    start, stride = places[int(torch.randint(len(places), (1,), generator=draw))]
    frames = start + stride * torch.arange(length)
    return frames.flip(0) if int(torch.randint(2, (1,), generator=draw)) else frames


def _each_frame_alike(weight: Tensor) -> Tensor:
    """B x S x P: the weights of a frame's points add up to 1, or are all 0."""
    return weight / weight.sum(-1, keepdim=True).clamp(min=1e-9)


def _mean(values: list[float]) -> float:
    return float(np.mean(values))
