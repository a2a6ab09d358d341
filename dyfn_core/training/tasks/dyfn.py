"""What both methods of training DyFN share: a frozen base with a DyFN on it, and its validation."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyfn_core.data.clips import draw_batch, find_sequences
from dyfn_core.models.base import (
    Affine,
    AffineDepth,
    AffineDisparity,
    AffinePoints,
    GeometryModel,
    Latent,
    image_to_batch,
)
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.dyfn import DyFN, DyFNConfig, build_dyfn
from dyfn_core.prediction import StreamState
from dyfn_core.quantities import scored_quantity
from dyfn_core.scoring.variants import VariantScore, VariantScorers, mean_scores
from dyfn_core.training.config import ConfigError
from dyfn_core.training.dyfn_config import DyFNRunConfig
from dyfn_core.training.loop.processes import full_precision
from dyfn_core.training.tasks.base import clip_source
from dyfn_core.training.tasks.latent_cache import LatentClips, encode_clips
from dyfn_core.training.tasks.pictures import coloured_depth
from dyfn_core.training.tasks.task import Task
from dyfn_core.training.tasks.validation import Sequence, recording_examples

logger = logging.getLogger(__name__)
VALIDATION_SEED = 1_000_000_007
SHOWN = 6  # frames of a picture


class DyFNTask(Task):
    """DyFN of any frozen base; no other parameter has gradients.

    Attributes:
        config: Settings of the run.
        source: Where its clips come from.
    """

    model: GeometryModel

    def __init__(self, config: DyFNRunConfig, device: torch.device | str = "cpu") -> None:
        self.config = config
        self.model = build_frozen(config).to(device)
        self.source = clip_source(config, config.method.cache_length, config.method.strides)
        if config.method.cache_seed is not None:
            self.source = replace(self.source, seed=config.method.cache_seed)

    @property
    def dyfn(self) -> DyFN:
        """What is trained."""
        assert self.model.stabilizer is not None  # build_frozen put it there
        return self.model.stabilizer

    def groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.dyfn.parameters()), "lr": self.config.learning_rate}]

    def decode(
        self, latents: Tensor, image_size: tuple[int, int], network_size: tuple[int, int]
    ) -> Affine:
        """Decode clips at half their size.

        Args:
            latents: B x T x C x h x w.
            image_size: Height and width of the images.
            network_size: Height and width that the latents were computed at.

        Returns:
            What the model predicts, float32, B x T x H/2 x W/2 (x 3).
        """
        half = (image_size[0] // 2, image_size[1] // 2)
        affine = self.model.decode(Latent(latents.flatten(0, 1), half, network_size))
        shape = latents.shape[:2]
        if isinstance(affine, AffineDisparity):
            return AffineDisparity(torch.unflatten(affine.disparity.float(), 0, shape))
        values = affine.points if isinstance(affine, AffinePoints) else affine.depth
        values, mask = (torch.unflatten(part.float(), 0, shape) for part in (values, affine.mask))
        if isinstance(affine, AffinePoints):
            return AffinePoints(values, mask)
        return AffineDepth(values, mask)

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
        scorers = VariantScorers(("dyfn",), scored_quantity(self.model.quantity))
        for features, depth in zip(sequence.latent, sequence.depth, strict=True):
            features = features[None].to(self.model.device).float()
            latent = Latent(features, sequence.image_size, sequence.network_size)
            if stabilized:
                latent, state = self.model.stabilize_latent(latent, state)
            affine = self.decode(latent.features[:, None], latent.image_size, latent.network_size)
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

    def clip_picture(self, clips: LatentClips) -> np.ndarray:
        """Draw some frames of the first clip: true depth, base and DyFN, one colour scale a row.

        Args:
            clips: One clip or more.

        Returns:
            A strip of images, H x W x 3 uint8 RGB.
        """
        one = replace(clips, latent=clips.latent[:1].to(self.model.device))
        stabilized = unroll(self.model, one)
        frames = list(range(0, len(stabilized), max(1, len(stabilized) // SHOWN)))[:SHOWN]
        base, ours = (
            _far_is_large(self.decode(latents[:, frames], clips.image_size, size))[0].cpu().numpy()
            for latents, size in (
                (one.latent.float(), clips.network_size),
                (torch.stack([x.features for x in stabilized], 1), stabilized[0].network_size),
            )
        )
        true = clips.depth[0, frames].float().cpu().numpy()
        return np.vstack([coloured_depth(np.hstack(list(row))) for row in (true, base, ours)])


def unroll(model: GeometryModel, clips: LatentClips) -> list[Latent]:
    """Pass clips through DyFN, the state passed along.

    Args:
        model: A model with a DyFN.
        clips: B clips of T frames.

    Returns:
        T latents of B frames each.
    """
    state: StreamState | None = None
    outputs = []
    with full_precision(clips.latent):  # statistics and the recurrence need it
        for features in clips.latent.float().unbind(1):
            latent = Latent(features, clips.image_size, clips.network_size)
            latent, state = model.stabilize_latent(latent, state)
            outputs.append(latent)
    return outputs


def _far_is_large(affine: Affine) -> Tensor:
    """z, or the inverse of disparity, for pictures."""
    if isinstance(affine, AffineDisparity):
        return 1 / affine.disparity.clamp(min=1e-6)
    return affine.values


def build_frozen(config: DyFNRunConfig) -> GeometryModel:
    """Load the base, frozen, with a DyFN on it: a fresh one, or its own (warm_start).

    Args:
        config: Settings of the run.

    Returns:
        The model, in training mode.

    Raises:
        ConfigError: If warm_start asks for a DyFN that the base does not have.
    """
    model = load_model(config.base)
    model.requires_grad_(False)
    if config.warm_start:
        if model.stabilizer is None:
            raise ConfigError(f"warm_start: {config.base} has no DyFN")
        model.stabilizer.requires_grad_(True)
        return model.train()
    torch.manual_seed(config.seed)
    described = DyFNConfig(**{"pool": model.stabilizer_pool, **config.dyfn})
    model.stabilizer = build_dyfn(model.latent_channels, described)
    return model.train()
