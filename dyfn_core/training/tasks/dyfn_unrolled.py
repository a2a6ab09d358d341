"""The unrolled method: DyFN over clips of cached latents, decoded; the paper's way of training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import yaml
from torch import Tensor

from dyfn_core.data.clips import batch_loader
from dyfn_core.losses.clip_alignment import clip_alignment_loss
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
from dyfn_core.losses.target import ClipTarget, on_rays, target_from_depth
from dyfn_core.models.base import Affine, AffineDepth, AffineDisparity, AffinePoints
from dyfn_core.quantities import scored_quantity
from dyfn_core.training.config import ConfigError
from dyfn_core.training.dyfn_config import (
    DisparityObjective,
    DyFNRunConfig,
    PaperObjective,
    TermsObjective,
    UnrolledMethod,
)
from dyfn_core.training.loop.processes import full_precision, part_seed, share_of
from dyfn_core.training.tasks.dyfn import DyFNTask, unroll
from dyfn_core.training.tasks.latent_cache import LatentCache, LatentClips, encode_clips


class UnrolledTask(DyFNTask):
    """DyFN unrolled over clips of latents; the decoder's output is compared with the truth.

    Raises ConfigError when the objective is not one for the base's output.
    """

    def __init__(
        self, config: DyFNRunConfig, cache_folder: Path, device: torch.device | str = "cpu"
    ) -> None:
        if not isinstance(config.method, UnrolledMethod):
            raise ConfigError(f"method.kind: expected 'unrolled', got {config.method.kind!r}")
        super().__init__(config, device)
        self.method = method = config.method
        self._check_objective()
        self.cache: LatentCache | None = None
        if method.cache_draws:
            folder = method.cache or cache_folder
            self.cache = LatentCache(
                folder, self.model, self.source, method.cache_draws, self.unreadable
            )

    def _check_objective(self) -> None:
        objective, quantity = self.method.objective, scored_quantity(self.model.quantity)
        wanted = "disparity" if isinstance(objective, DisparityObjective) else "depth"
        if quantity == wanted:
            return
        model = DisparityObjective if quantity == "disparity" else TermsObjective
        shared = ("decoded", "windows", "temporal_weight")
        kept = {n: v for n, v in objective.model_dump(mode="json").items() if n in shared}
        kind = model.model_fields["kind"].default
        mended = yaml.safe_dump({"kind": kind, **kept}, default_flow_style=True, sort_keys=False)
        raise ConfigError(
            f"method.objective.kind: {objective.kind!r} is not for {self.config.base}, which "
            f"predicts {quantity}: set method.objective to {mended.strip()}"
        )

    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[LatentClips]:
        clips = share_of(self.method.clips, parts, "clips")
        seed = part_seed(self.config.seed, part)
        if self.cache is not None:
            return self.cache.batches(start, seed, clips, self.method.length)
        stages = tuple(replace(stage, batch=clips) for stage in self.source.stages)
        source = replace(self.source, length=self.method.length, stages=stages, seed=seed)
        loader = batch_loader(source, start, self.unreadable)
        return (encode_clips(self.model, batch) for batch in loader)

    def images(self, batch: LatentClips) -> int:
        return batch.latent.shape[0] * batch.latent.shape[1]

    def loss(self, batch: LatentClips) -> tuple[Tensor, dict[str, float]]:
        frames = self._decoded_frames()
        stabilized = unroll(self.model, batch)
        chosen = torch.stack([stabilized[j].features for j in frames], 1)
        affine = self.decode(chosen, batch.image_size, stabilized[0].network_size)
        depth = batch.depth[:, frames].float().flatten(0, 1)
        aspect = batch.image_size[1] / batch.image_size[0]
        truth = target_from_depth(depth, batch.intrinsics[:, frames].flatten(0, 1), aspect)
        if isinstance(affine, AffineDepth):  # the losses are of points: on the true rays
            points = on_rays(affine.depth.flatten(0, 1), batch.intrinsics[:, frames].flatten(0, 1))
            affine = AffinePoints(torch.unflatten(points, 0, affine.depth.shape[:2]), affine.mask)
        with full_precision(depth):
            total, terms = self._terms(affine, ClipTarget(truth, len(frames)), frames)
        values = {name: float(term.detach()) for name, term in terms.items()}
        return total, {"loss": float(total.detach()), **values}

    def _decoded_frames(self) -> list[int]:
        """The first frame, a run of neighbours for the temporal loss, and a few at random."""
        length, objective = self.method.length, self.method.objective
        if isinstance(objective, PaperObjective):
            return list(range(length))
        count = min(objective.decoded, length)
        run = min(count - 1, max(objective.windows) + 1)
        start = 1 + int(torch.randint(max(1, length - run), (1,)))
        chosen = {0, *range(start, min(start + run, length))}
        others = [j for j in torch.randperm(length).tolist() if j not in chosen]
        return sorted([*chosen, *others[: count - len(chosen)]])

    def _terms(
        self, affine: Affine, target: ClipTarget, frames: list[int]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The weighted sum, and every term by name."""
        objective = self.method.objective
        if isinstance(objective, PaperObjective):
            assert isinstance(affine, AffinePoints)
            described = objective.objective()
            terms = described.terms(affine.points, affine.mask, target)
            return described.total(terms, len(target.frames.points)), terms
        if isinstance(objective, DisparityObjective):
            assert isinstance(affine, AffineDisparity)
            terms = _disparity_terms(objective, affine.disparity, target, frames)
        else:
            assert isinstance(affine, AffinePoints)
            terms = _point_terms(objective, affine.points, target, frames)
        weights = objective.weights()
        return torch.stack([weights[name] * terms[name] for name in terms]).sum(), terms

    def picture(self, batch: LatentClips) -> np.ndarray:
        return self.clip_picture(batch)


def _point_terms(
    objective: TermsObjective, points: Tensor, target: ClipTarget, frames: list[int]
) -> dict[str, Tensor]:
    through = objective.align_differentiable
    scale, shift = align_clips(points, target, "first", through)
    terms = {"align_first": clip_alignment_loss(points, target, scale, shift)}
    every = align_clips(points, target, "all")
    terms["align_all"] = clip_alignment_loss(points, target, *every)
    terms["temporal"] = temporal_loss(points, target, scale, objective.windows, frames)
    flat = points.flatten(0, 1)
    terms["frame"] = global_loss(flat, target.frames, *align_frames(flat, target.frames))
    terms["spread"] = scale_spread_loss(points, target)
    return terms


def _disparity_terms(
    objective: DisparityObjective, disparity: Tensor, target: ClipTarget, frames: list[int]
) -> dict[str, Tensor]:
    scale, shift = align_disparity(disparity, target, "first")
    pairs = window_pairs(frames, objective.windows)
    return {
        "ssi": ssi_loss(disparity.flatten(0, 1), target.frames),
        "temporal": disparity_temporal_loss(disparity, target, scale, pairs),
        "align_first": disparity_alignment_loss(disparity, target, scale, shift),
    }
