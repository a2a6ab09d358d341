"""Training DyFN on a frozen base: clips of cached latents, alignment and temporal losses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyfn_core.data.clips import batch_loader, draw_batch, find_sequences
from dyfn_core.losses.clip_alignment import ClipTarget, align_clips, clip_alignment_loss
from dyfn_core.losses.scale_spread import scale_spread_loss
from dyfn_core.losses.target import target_from_depth
from dyfn_core.losses.temporal import temporal_loss, window_pairs
from dyfn_core.losses.whole_frame import whole_frame_loss
from dyfn_core.models.base import Latent
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.mini import MiniModel, remap_exp
from dyfn_core.models.stabilizer import StabilizerConfig, build_stabilizer
from dyfn_core.prediction import StreamState
from dyfn_core.training.base import clip_source
from dyfn_core.training.config import ConfigError, StabilizerRunConfig
from dyfn_core.training.latents import LatentCache, LatentClips, encode_clips
from dyfn_core.training.pictures import coloured_depth
from dyfn_core.training.processes import full_precision, part_seed, share_of
from dyfn_core.training.trainer import Task
from dyfn_core.training.validation import Sequence, recording_examples, sequence_scores

VALIDATION_SEED = 1_000_000_007


class StabilizerTask(Task):
    """DyFN of a frozen `mini`; no other parameter has gradients."""

    model: MiniModel

    def __init__(
        self, config: StabilizerRunConfig, cache_folder: Path, device: torch.device | str = "cpu"
    ) -> None:
        self.config = config
        self.model = build_frozen(config).to(device)
        self.source = clip_source(config, config.cache_length, config.strides)
        if config.cache_seed is not None:
            self.source = replace(self.source, seed=config.cache_seed)
        self.cache: LatentCache | None = None
        if config.cache_draws:
            folder = config.cache or cache_folder
            self.cache = LatentCache(folder, self.model, self.source, config.cache_draws)
        self.sequences: dict[str, list[Sequence]] = {}

    def groups(self) -> list[dict[str, Any]]:
        stabilizer = self.model.stabilizer
        assert stabilizer is not None
        return [{"params": list(stabilizer.parameters()), "lr": self.config.learning_rate}]

    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[LatentClips]:
        clips = share_of(self.config.clips, parts, "clips")
        seed = part_seed(self.config.seed, part)
        if self.cache is not None:
            return self.cache.batches(start, seed, clips, self.config.length)
        stages = tuple(replace(stage, batch=clips) for stage in self.source.stages)
        source = replace(self.source, length=self.config.length, stages=stages, seed=seed)
        return (encode_clips(self.model, batch) for batch in batch_loader(source, start))

    def images(self, batch: LatentClips) -> int:
        return batch.latent.shape[0] * batch.latent.shape[1]

    def loss(self, batch: LatentClips) -> tuple[Tensor, dict[str, float]]:
        frames = self._decoded_frames()
        latents = unroll(self.model, batch.latent.float())
        points = self._decode(torch.stack([latents[j] for j in frames], 1), batch.image_size)
        with full_precision(points):
            return self._terms(batch, points, frames)

    def _terms(
        self, batch: LatentClips, points: Tensor, frames: list[int]
    ) -> tuple[Tensor, dict[str, float]]:
        depth = batch.depth[:, frames].float().flatten(0, 1)
        aspect = batch.image_size[1] / batch.image_size[0]
        truth = target_from_depth(depth, batch.intrinsics[:, frames].flatten(0, 1), aspect)
        target = ClipTarget(truth, len(frames))
        terms: dict[str, Tensor] = {}
        first_scale = None
        for mode in ("first", "all"):
            through = self.config.align_differentiable
            scale, shift = align_clips(points, target, mode, through and mode == "first")
            terms[f"align_{mode}"] = clip_alignment_loss(points, target, scale, shift)
            first_scale = scale if first_scale is None else first_scale
        pairs = window_pairs(frames, self.config.windows)
        assert first_scale is not None
        terms["temporal"] = temporal_loss(points, target, first_scale, pairs)
        terms["frame"] = whole_frame_loss(points.flatten(0, 1), truth)[0]
        terms["spread"] = scale_spread_loss(points, target)
        weights = self.config.loss_weights()
        total = torch.stack([weights[name] * term for name, term in terms.items()]).sum()
        values = {name: float(term.detach()) for name, term in terms.items()}
        return total, {"loss": float(total.detach()), **values}

    def _decoded_frames(self) -> list[int]:
        """The first frame, a run of neighbours for the temporal loss, and a few at random."""
        length, count = self.config.length, min(self.config.decoded, self.config.length)
        run = min(count - 1, max(self.config.windows) + 1)
        start = 1 + int(torch.randint(max(1, length - run), (1,)))
        chosen = {0, *range(start, min(start + run, length))}
        others = [j for j in torch.randperm(length).tolist() if j not in chosen]
        return sorted([*chosen, *others[: count - len(chosen)]])

    def _decode(self, latents: Tensor, size: tuple[int, int]) -> Tensor:
        """latents B x T x C x h x w -> points B x T x H/2 x W/2 x 3."""
        raw, _ = self.model.decode_raw(Latent(latents.flatten(0, 1), size, size))
        return remap_exp(raw.float()).unflatten(0, latents.shape[:2])

    def validate(self) -> dict[str, float]:
        """Image and video AbsRel with and without DyFN; `score` is the rendered video's."""
        if not self.sequences:
            self.sequences = self._find_sequences()
        scores = {}
        for name, sequences in self.sequences.items():
            for kind, stabilized in (("base", False), ("dyfn", True)):
                found = [self._score(sequence, stabilized) for sequence in sequences]
                for protocol in ("image", "video"):
                    mean = float(np.mean([score[protocol] for score in found]))
                    scores[f"{name}_{kind}_{protocol}"] = mean
        return {**scores, "score": scores["rendered_dyfn_video"]}

    def _score(self, sequence: Sequence, stabilized: bool) -> dict[str, float]:
        state: StreamState | None = None
        predicted = []
        for features in sequence.latent:
            features = features[None].to(self.model.device).float()
            if stabilized:
                features, state = self.model.stabilize(features, state)
            raw, _ = self.model.decode_raw(Latent(features, *2 * (sequence.image_size,)))
            predicted.append(raw[0, 2].exp().cpu().numpy())
        return sequence_scores(predicted, [depth.float().numpy() for depth in sequence.depth])

    def _find_sequences(self) -> dict[str, list[Sequence]]:
        found = {"rendered": self._rendered_sequences()}
        if self.config.validation_rgbd is not None:
            found["recorded"] = [self._recorded_sequence()]
        return found

    def _rendered_sequences(self) -> list[Sequence]:
        """The same clips each time: unaugmented, from held-out worlds if there are any."""
        source = replace(self.source, augment_strength=0.0, smallest_view=1.0, seed=VALIDATION_SEED)
        try:
            found = find_sequences(source, "held_out")
        except FileNotFoundError:
            found = find_sequences(source, "train")
        sequences: list[Sequence] = []
        draw = 0
        while len(sequences) < self.config.validation_clips:
            clips = encode_clips(self.model, draw_batch(source, found, draw))
            sequences += [
                Sequence(latent, depth, clips.image_size)
                for latent, depth in zip(clips.latent, clips.depth, strict=True)
            ]
            draw += 1
        return sequences[: self.config.validation_clips]

    def _recorded_sequence(self) -> Sequence:
        assert self.config.validation_rgbd is not None
        examples = recording_examples(self.config.validation_rgbd, self.config.validation_stride)
        latents, depths = [], []
        size = self.model.network_size(examples[0].image.shape[:2], None)
        for example in examples:
            image = torch.from_numpy(np.ascontiguousarray(example.image)).permute(2, 0, 1)[None]
            image = image.to(self.model.device).float() / 255
            latents.append(self.model.encode_at(image, size).features[0].half().cpu())
            rows = (np.arange(size[0] // 2) * 2 + 1) * example.depth.shape[0] // size[0]
            cols = (np.arange(size[1] // 2) * 2 + 1) * example.depth.shape[1] // size[1]
            depths.append(torch.from_numpy(example.depth[rows[:, None], cols[None, :]]))
        return Sequence(torch.stack(latents), torch.stack(depths), size)

    def picture(self, batch: LatentClips) -> np.ndarray:
        """True depth, base and DyFN of one clip's frames, one colour scale a row."""
        latent, size = batch.latent[:1].to(self.model.device).float(), batch.image_size
        stabilized = torch.stack(unroll(self.model, latent), 1)
        frames = list(range(0, latent.shape[1], max(1, latent.shape[1] // 6)))[:6]
        base, ours = (
            self._decode(which[:, frames], size)[0, ..., 2].cpu().numpy()
            for which in (latent, stabilized)
        )
        true = batch.depth[0, frames].float().cpu().numpy()
        return np.vstack([coloured_depth(np.hstack(list(row))) for row in (true, base, ours)])


def unroll(model: MiniModel, latents: Tensor) -> list[Tensor]:
    """latents B x T x C x h x w -> T stabilized latents, the state passed along."""
    state: StreamState | None = None
    outputs = []
    for features in latents.unbind(1):
        stabilized, state = model.stabilize(features, state)
        outputs.append(stabilized)
    return outputs


def build_frozen(config: StabilizerRunConfig) -> MiniModel:
    """The base of a checkpoint, frozen, with a DyFN on it: a fresh one, or its own (warm_start)."""
    model = load_model(config.base)
    if not isinstance(model, MiniModel):
        raise ConfigError(f"base: {config.base} is no model of type 'mini'")
    model.requires_grad_(False)
    if config.warm_start:
        if model.stabilizer is None:
            raise ConfigError(f"warm_start: {config.base} has no DyFN")
        model.stabilizer.requires_grad_(True)
        return model.train()
    torch.manual_seed(config.seed)
    described = StabilizerConfig(**config.stabilizer)
    model.stabilizer = build_stabilizer(model.latent_channels, described)
    return model.train()
