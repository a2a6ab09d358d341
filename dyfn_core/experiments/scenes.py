"""What experiments are scored on: sequences encoded once, decoded for every way to stabilize."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch

from dyfn_core.evaluation.variants import VariantScore
from dyfn_core.models.base import GeometryModel, Latent
from dyfn_core.models.controls import ema_control, frozen_control, stabilized_by
from dyfn_core.models.dyfn import DyFN
from dyfn_core.prediction import DEPTH, StreamState
from dyfn_core.scoring.protocols import CONTROLS, SequenceScorer, to_shape

METRICS = tuple(field.name for field in fields(VariantScore))
BASE_ROWS = ("ramp", "constant", "base", "ema", "frozen")


@dataclass(frozen=True)
class Scene:
    """A sequence after the encoder: latents of its frames, and true depth H x W metres each."""

    name: str
    latents: list[Latent]
    depth: list[np.ndarray]


@torch.inference_mode()
def encode_scene(
    model: GeometryModel, name: str, frames: Iterable[tuple[np.ndarray, np.ndarray]]
) -> Scene:
    """frames: RGB H x W x 3 uint8 and depth h x w metres (not finite or <= 0: unknown)."""
    latents, depths = [], []
    for image, depth in frames:
        pixels = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None]
        latents.append(model.encode(pixels.to(model.device).float() / 255))
        depths.append(np.where(np.isfinite(depth), depth, np.nan).astype(np.float32))
    return Scene(name, latents, depths)


@torch.inference_mode()
def predictions(
    model: GeometryModel, scene: Scene, stabilizer: DyFN | None
) -> Iterator[np.ndarray]:
    """Affine depth (or disparity) of each frame, at the size of its truth, so stabilized."""
    state: StreamState | None = None
    for latent, truth in zip(scene.latents, scene.depth, strict=True):
        with stabilized_by(model, stabilizer):
            changed, state = model.stabilize_latent(latent, state)
        depth = model.decode(changed).values[0].float().cpu().numpy()
        yield to_shape(depth, truth.shape)


def score_stabilizer(
    model: GeometryModel, scenes: Sequence[Scene], stabilizer: DyFN | None
) -> VariantScore:
    """Mean over the scenes of AbsRel and delta1 under the image and video protocols."""
    return _mean([_score(s, predictions(model, s, stabilizer), model.quantity) for s in scenes])


def score_controls(model: GeometryModel, scenes: Sequence[Scene]) -> dict[str, VariantScore]:
    """What DyFN has to beat: ramp, constant, base, moving average, the first frame's statistics."""
    channels = model.latent_channels
    found: dict[str, VariantScore] = {
        name: _mean([_score(s, (control(_size(d)) for d in s.depth)) for s in scenes])
        for name, control in CONTROLS.items()
    }
    found["base"] = score_stabilizer(model, scenes, None)
    found["ema"] = score_stabilizer(model, scenes, ema_control(channels))
    found["frozen"] = score_stabilizer(model, scenes, frozen_control(channels))
    return found


def scores_by_length(
    scene: Scene, predicted: Iterable[np.ndarray], lengths: Sequence[int], quantity: str = DEPTH
) -> dict[int, float]:
    """Video AbsRel of the first n frames, aligned anew for each n that the scene reaches."""
    scorer, found = SequenceScorer(quantity=quantity), {}
    for count, (depth, truth) in enumerate(zip(predicted, scene.depth, strict=True), 1):
        scorer.push(depth, truth)
        if count in lengths:
            video = scorer.video()
            if video is not None:
                found[count] = video.metrics["abs_rel"]
    return found


def _score(scene: Scene, predicted: Iterable[np.ndarray], quantity: str = DEPTH) -> VariantScore:
    scorer = SequenceScorer(quantity=quantity)
    for depth, truth in zip(predicted, scene.depth, strict=True):
        scorer.push(depth, truth)
    image, video = scorer.image(), scorer.video()
    if image is None or video is None:
        raise ValueError(f"{scene.name} has no frame with enough valid depth to score")
    both = [score.metrics[name] for score in (image, video) for name in ("abs_rel", "delta1")]
    return VariantScore(*both)


def _size(depth: np.ndarray) -> tuple[int, int]:
    return (depth.shape[0], depth.shape[1])


def _mean(scores: list[VariantScore]) -> VariantScore:
    return VariantScore(*(float(np.mean([getattr(s, name) for s in scores])) for name in METRICS))
