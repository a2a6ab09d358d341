"""Training DyFN on a frozen base: clips of cached latents, alignment and temporal losses."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyfn_core.data.clips import batch_loader, draw_batch, find_sequences
from dyfn_core.losses.clip_alignment import clip_alignment_loss
from dyfn_core.losses.full.objective import Objective
from dyfn_core.losses.full.ssi import ssi_loss
from dyfn_core.losses.motion import window_pairs
from dyfn_core.losses.sampled.clip_alignment import align_clips
from dyfn_core.losses.sampled.disparity import (
    align_disparity,
    disparity_alignment_loss,
    disparity_temporal_loss,
)
from dyfn_core.losses.sampled.temporal import temporal_loss
from dyfn_core.losses.sampled.whole_frame import align_frames, global_loss
from dyfn_core.losses.scale_spread import scale_spread_loss
from dyfn_core.losses.target import ClipTarget, target_from_depth
from dyfn_core.models.base import (
    AffineDisparity,
    AffinePoints,
    GeometryModel,
    Latent,
    image_to_batch,
)
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.prediction import StreamState
from dyfn_core.scoring.variants import VariantScore, VariantScorers, mean_scores
from dyfn_core.training.config import ConfigError, StabilizerRunConfig
from dyfn_core.training.loop.processes import full_precision, part_seed, share_of
from dyfn_core.training.tasks.base import clip_source
from dyfn_core.training.tasks.latent_cache import LatentCache, LatentClips, encode_clips
from dyfn_core.training.tasks.pictures import coloured_depth
from dyfn_core.training.tasks.task import Task
from dyfn_core.training.tasks.validation import Sequence, recording_examples

logger = logging.getLogger(__name__)
VALIDATION_SEED = 1_000_000_007


class StabilizerTask(Task):
    """DyFN of any frozen base; no other parameter has gradients."""

    model: GeometryModel

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
            self.cache = LatentCache(
                folder, self.model, self.source, config.cache_draws, self.unreadable
            )
        described = config.objective
        self.objective = None if described is None else Objective.from_dict(described)

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
        loader = batch_loader(source, start, self.unreadable)
        return (encode_clips(self.model, batch) for batch in loader)

    def images(self, batch: LatentClips) -> int:
        return batch.latent.shape[0] * batch.latent.shape[1]

    def loss(self, batch: LatentClips) -> tuple[Tensor, dict[str, float]]:
        frames = self._decoded_frames()
        stabilized = unroll(self.model, batch)
        chosen = torch.stack([stabilized[j].features for j in frames], 1)
        affine = self._decode(chosen, batch.image_size, stabilized[0].network_size)
        depth = batch.depth[:, frames].float().flatten(0, 1)
        aspect = batch.image_size[1] / batch.image_size[0]
        truth = target_from_depth(depth, batch.intrinsics[:, frames].flatten(0, 1), aspect)
        target = ClipTarget(truth, len(frames))
        with full_precision(depth):
            if isinstance(affine, AffineDisparity):
                terms = self._disparity_terms(affine.disparity, target, frames)
                weights = self.config.disparity_weights()
                total = torch.stack([weights[name] * terms[name] for name in terms]).sum()
            elif self.objective is not None:
                terms = self.objective.terms(affine.points, affine.mask, target)
                total = self.objective.total(terms, len(truth.points))
            else:
                terms = self._point_terms(affine.points, target, frames)
                weights = self.config.loss_weights()
                total = torch.stack([weights[name] * terms[name] for name in terms]).sum()
        values = {name: float(term.detach()) for name, term in terms.items()}
        return total, {"loss": float(total.detach()), **values}

    def _point_terms(
        self, points: Tensor, target: ClipTarget, frames: list[int]
    ) -> dict[str, Tensor]:
        terms: dict[str, Tensor] = {}
        first_scale = None
        for mode in ("first", "all"):
            through = self.config.align_differentiable
            scale, shift = align_clips(points, target, mode, through and mode == "first")
            terms[f"align_{mode}"] = clip_alignment_loss(points, target, scale, shift)
            first_scale = scale if first_scale is None else first_scale
        assert first_scale is not None
        windows = self.config.windows
        terms["temporal"] = temporal_loss(points, target, first_scale, windows, frames)
        flat = points.flatten(0, 1)
        terms["frame"] = global_loss(flat, target.frames, *align_frames(flat, target.frames))
        terms["spread"] = scale_spread_loss(points, target)
        return terms

    def _disparity_terms(
        self, disparity: Tensor, target: ClipTarget, frames: list[int]
    ) -> dict[str, Tensor]:
        scale, shift = align_disparity(disparity, target, "first")
        pairs = window_pairs(frames, self.config.windows)
        return {
            "ssi": ssi_loss(disparity.flatten(0, 1), target.frames),
            "temporal": disparity_temporal_loss(disparity, target, scale, pairs),
            "align_first": disparity_alignment_loss(disparity, target, scale, shift),
        }

    def _decoded_frames(self) -> list[int]:
        """The first frame, a run of neighbours for the temporal loss, and a few at random."""
        length, count = self.config.length, min(self.config.decoded, self.config.length)
        if self.objective is not None:
            return list(range(length))
        run = min(count - 1, max(self.config.windows) + 1)
        start = 1 + int(torch.randint(max(1, length - run), (1,)))
        chosen = {0, *range(start, min(start + run, length))}
        others = [j for j in torch.randperm(length).tolist() if j not in chosen]
        return sorted([*chosen, *others[: count - len(chosen)]])

    def _decode(
        self, latents: Tensor, image_size: tuple[int, int], network_size: tuple[int, int]
    ) -> AffinePoints | AffineDisparity:
        """latents B x T x C x h x w -> what the model says, B x T x H/2 x W/2 (x 3)."""
        half = (image_size[0] // 2, image_size[1] // 2)
        affine = self.model.decode(Latent(latents.flatten(0, 1), half, network_size))
        shape = latents.shape[:2]
        if isinstance(affine, AffineDisparity):
            return AffineDisparity(affine.disparity.float().unflatten(0, shape))
        points, mask = affine.points.float(), affine.mask.float()
        return AffinePoints(points.unflatten(0, shape), mask.unflatten(0, shape))

    def validate(self) -> dict[str, float]:
        """Image and video AbsRel with and without DyFN; `score` is the rendered video's.

        NaN where no validation clip has a known depth.
        """
        scores = {**self.base_scores, **self._scores("dyfn")}
        if not np.isfinite(scores["rendered_dyfn_video"]):
            logger.warning("no depth is known in the validation clips: nothing to score")
        return {**scores, "score": scores["rendered_dyfn_video"]}

    def _scores(self, kind: str) -> dict[str, float]:
        scores = {}
        for name, sequences in self.sequences.items():
            found = mean_scores(self._score(sequence, kind == "dyfn") for sequence in sequences)
            scores[f"{name}_{kind}_image"] = found.image_abs_rel
            scores[f"{name}_{kind}_video"] = found.video_abs_rel
        return scores

    def _score(self, sequence: Sequence, stabilized: bool) -> VariantScore | None:
        state: StreamState | None = None
        scorers = VariantScorers(("dyfn",), self.model.quantity)
        for features, depth in zip(sequence.latent, sequence.depth, strict=True):
            features = features[None].to(self.model.device).float()
            latent = Latent(features, sequence.image_size, sequence.network_size)
            if stabilized:
                latent, state = self.model.stabilize_latent(latent, state)
            affine = self._decode(latent.features[:, None], latent.image_size, latent.network_size)
            predicted = affine.values[0, 0].cpu().numpy()
            scorers.push({"dyfn": predicted}, depth.float().numpy())
        return scorers.scores()["dyfn"]

    @cached_property
    def base_scores(self) -> dict[str, float]:
        """Of the base alone, which is frozen."""
        return self._scores("base")

    @cached_property
    def sequences(self) -> dict[str, list[Sequence]]:
        """What is validated on, encoded."""
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
            logger.warning("nothing is held out: validation is on clips that are trained on")
        sequences: list[Sequence] = []
        draw = 0
        while len(sequences) < self.config.validation_clips:
            unreadable: list[str] = []
            clips = encode_clips(self.model, draw_batch(source, found, draw, unreadable))
            self.unreadable.update(unreadable)
            sequences += [
                Sequence(latent, depth, clips.image_size, clips.network_size)
                for latent, depth in zip(clips.latent, clips.depth, strict=True)
            ]
            draw += 1
        return sequences[: self.config.validation_clips]

    def _recorded_sequence(self) -> Sequence:
        assert self.config.validation_rgbd is not None
        examples = recording_examples(self.config.validation_rgbd, self.config.validation_stride)
        latents, depths = [], []
        size = (0, 0)
        for example in examples:
            latent = self.model.encode(image_to_batch(example.image, self.model.device)[0])
            size = latent.network_size
            latents.append(latent.features[0].half().cpu())
            rows = (np.arange(size[0] // 2) * 2 + 1) * example.depth.shape[0] // size[0]
            cols = (np.arange(size[1] // 2) * 2 + 1) * example.depth.shape[1] // size[1]
            depths.append(torch.from_numpy(example.depth[rows[:, None], cols[None, :]]))
        return Sequence(torch.stack(latents), torch.stack(depths), size, size)

    def picture(self, batch: LatentClips) -> np.ndarray:
        """True depth, base and DyFN of one clip's frames, one colour scale a row."""
        one = replace(batch, latent=batch.latent[:1].to(self.model.device))
        stabilized = unroll(self.model, one)
        frames = list(range(0, len(stabilized), max(1, len(stabilized) // 6)))[:6]
        base, ours = (
            far_is_large(self._decode(latents[:, frames], batch.image_size, size))[0].cpu().numpy()
            for latents, size in (
                (one.latent.float(), batch.network_size),
                (torch.stack([x.features for x in stabilized], 1), stabilized[0].network_size),
            )
        )
        true = batch.depth[0, frames].float().cpu().numpy()
        return np.vstack([coloured_depth(np.hstack(list(row))) for row in (true, base, ours)])


def far_is_large(affine: AffinePoints | AffineDisparity) -> Tensor:
    """z, or the inverse of disparity, for pictures."""
    if isinstance(affine, AffineDisparity):
        return 1 / affine.disparity.clamp(min=1e-6)
    return affine.points[..., 2]


def unroll(model: GeometryModel, clips: LatentClips) -> list[Latent]:
    """The clips' T stabilized latents, the state passed along."""
    state: StreamState | None = None
    outputs = []
    with full_precision(clips.latent):  # statistics and the recurrence need it
        for features in clips.latent.float().unbind(1):
            latent = Latent(features, clips.image_size, clips.network_size)
            latent, state = model.stabilize_latent(latent, state)
            outputs.append(latent)
    return outputs


def build_frozen(config: StabilizerRunConfig) -> GeometryModel:
    """The base of a checkpoint, frozen, with a DyFN on it: a fresh one, or its own (warm_start)."""
    model = load_model(config.base)
    model.requires_grad_(False)
    if config.warm_start:
        if model.stabilizer is None:
            raise ConfigError(f"warm_start: {config.base} has no DyFN")
        model.stabilizer.requires_grad_(True)
        return model.train()
    torch.manual_seed(config.seed)
    described = DyFNConfig(**{"pool": model.stabilizer_pool, **config.stabilizer})
    model.stabilizer = build_dyfn(model.latent_channels, described)
    return model.train()
