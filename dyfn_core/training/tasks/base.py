"""Training the small base model: encoder and head on single frames, MoGe's objective."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyfn_core.data.clips import ClipBatch, ClipSource, SizeStage, batch_loader, find_sequences
from dyfn_core.losses.canonical_scale import canonical_scale_loss
from dyfn_core.losses.gradient import gradient_loss
from dyfn_core.losses.sampled.local import local_loss
from dyfn_core.losses.sampled.mask import mask_loss
from dyfn_core.losses.sampled.normal import normal_loss
from dyfn_core.losses.sampled.whole_frame import align_frames, global_loss
from dyfn_core.losses.target import target_from_depth
from dyfn_core.models.checkpoints import load_model
from dyfn_core.models.efficientnet import EfficientNetLite0, InvertedResidual
from dyfn_core.models.mini import MiniConfig, MiniModel, remap_exp
from dyfn_core.training.config import BaseRunConfig, ConfigError, RunConfig
from dyfn_core.training.loop.processes import full_precision, part_seed, share_of
from dyfn_core.training.tasks.pictures import picture_rows
from dyfn_core.training.tasks.task import Task
from dyfn_core.training.tasks.validation import Example, recording_examples, score, spread_examples

LOCAL_LEVELS = (1 / 4, 1 / 16)
LARGEST_RAW = 4.0  # raw points beyond this are pulled back: the losses do not fix their scale


def clip_source(config: RunConfig, length: int, strides: tuple[int, int]) -> ClipSource:
    """Where a run's training clips come from."""
    return ClipSource(
        data=tuple(data.spec() for data in config.data),
        kinds=config.kinds,
        length=length,
        strides=strides,
        stages=tuple(
            SizeStage(s.from_step, s.sizes, s.batch, s.area, s.aspect, s.tokens)
            for s in config.stages
        ),
        augment_strength=config.augment_strength,
        smallest_view=config.smallest_view,
        fov=config.fov,
        depth_clamp=config.depth_clamp,
        workers=config.loader_workers,
        seed=config.seed,
    )


def part_source(source: ClipSource, part: int, parts: int) -> ClipSource:
    """The same clips in batches of 1 / parts, drawn with the part's own seed."""
    stages = tuple(
        replace(stage, batch=share_of(stage.batch, parts, "the batch of a stage"))
        for stage in source.stages
    )
    return replace(source, stages=stages, seed=part_seed(source.seed, part))


class BaseTask(Task):
    """The whole of `mini` on frames: whole-frame, local, normal and mask errors."""

    model: MiniModel

    def __init__(self, config: BaseRunConfig, device: torch.device | str = "cpu") -> None:
        self.config = config
        model = build_base(config).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.model = model.to(device)
        self.source = clip_source(config, 1, (1, 1))
        self.examples: dict[str, list[Example]] = {}

    def groups(self) -> list[dict[str, Any]]:
        rate = self.config.learning_rate
        encoder = [p for p in self.model.encoder.parameters() if p.requires_grad]
        head = [*self.model.neck.parameters(), *self.model.decoder.parameters()]
        return [
            {"params": encoder, "lr": rate * self.config.encoder_rate},
            {"params": head, "lr": rate},
        ]

    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[ClipBatch]:
        return batch_loader(part_source(self.source, part, parts), start, self.unreadable)

    def images(self, batch: ClipBatch) -> int:
        return len(batch.image)

    def loss(self, batch: ClipBatch) -> tuple[Tensor, dict[str, float]]:
        raw, mask, aspect = self._forward(batch)
        with full_precision(raw):
            return self._terms(batch, raw.float(), mask.float(), aspect)

    def _terms(
        self, batch: ClipBatch, raw: Tensor, mask: Tensor, aspect: float
    ) -> tuple[Tensor, dict[str, float]]:
        target = target_from_depth(batch.depth[:, 0], batch.intrinsics[:, 0], aspect)
        points = remap_exp(raw)
        scale, shift = align_frames(points, target)
        frame = global_loss(points, target, scale, shift)
        local = [
            local_loss(points, target, scale, alpha, balls)
            for alpha, balls in zip(LOCAL_LEVELS, self.config.balls, strict=True)
        ]
        normal = normal_loss(points, target, self.config.normal_stride)
        masks, canonical = mask_loss(mask, target), canonical_scale_loss(points, target)
        edges = gradient_loss(points, target)
        excess = (raw.abs() - LARGEST_RAW).clamp(min=0).square().mean()
        total = (
            frame
            + self.config.local_weight * torch.stack(local).sum()
            + self.config.normal_weight * normal
            + self.config.mask_weight * masks
            + self.config.scale_weight * canonical
            + self.config.gradient_weight * edges
            + excess
        )
        terms = {
            "loss": total,
            "frame": frame,
            "local_4": local[0],
            "local_16": local[1],
            "normal": normal,
            "mask": masks,
            "scale": canonical,
            "edges": edges,
            "excess": excess,
        }
        return total, {name: float(term.detach()) for name, term in terms.items()}

    def _forward(self, batch: ClipBatch) -> tuple[Tensor, Tensor, float]:
        image = batch.image[:, 0].float() / 255
        size = (image.shape[-2], image.shape[-1])
        raw, mask = self.model.decode_raw(self.model.encode_at(image, size))
        return raw, mask, size[1] / size[0]

    def validate(self) -> dict[str, float]:
        """`score` is the error on held-out worlds, on the training ones where none is held out."""
        if not self.examples:
            self.examples = validation_examples(self.config, self.source)
        scores = {}
        for name, examples in self.examples.items():
            for metric, value in score(self.model, examples).items():
                scores[f"{name}_{metric}"] = value
        return {**scores, "score": scores["rendered_abs_rel"]}

    def picture(self, batch: ClipBatch) -> np.ndarray:
        raw, _, _ = self._forward(batch)
        return picture_rows(batch, raw[:, 2].exp())

    def export_model(self) -> MiniModel:
        return self.model.folded()


def build_base(config: BaseRunConfig) -> MiniModel:
    """The model at step 0: ImageNet weights in the encoder, or a checkpoint."""
    torch.manual_seed(config.seed)
    if config.initial is not None:
        model = load_model(Path(config.initial))
        if not isinstance(model, MiniModel):
            raise ConfigError(f"initial: {config.initial} is no model of type 'mini'")
    else:
        model = MiniModel(MiniConfig(**{**config.model, "folded": False}))
        model.load_imagenet_encoder()
    freeze_encoder(model.encoder, config.frozen_blocks, config.frozen_depthwise)
    return model.train()


def freeze_encoder(encoder: EfficientNetLite0, blocks: int, depthwise: bool) -> None:
    """Exclude the stem and first blocks, and the depthwise filters, from training.

    The weight gradients of 5 x 5 depthwise convolutions are the slowest part of a step on CPUs.
    """
    encoder.frozen_blocks = blocks
    frozen = [encoder.stem, *encoder.blocks[:blocks]] if blocks else []
    for module in frozen:
        module.requires_grad_(False)
    for block in encoder.blocks:
        if depthwise and isinstance(block, InvertedResidual):
            block.depthwise.requires_grad_(False)


def validation_examples(config: BaseRunConfig, source: ClipSource) -> dict[str, list[Example]]:
    """Frames to validate on: "rendered", and "recorded" when the config names a recording."""
    try:
        pool = find_sequences(source, "held_out")
    except FileNotFoundError:
        pool = find_sequences(source, "train")
    examples = {"rendered": spread_examples(pool.sequences, config.validation_frames)}
    if config.validation_rgbd is not None:
        examples["recorded"] = recording_examples(config.validation_rgbd)
    return examples
