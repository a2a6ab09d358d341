"""How a model does on frames of a recording: against triangulated points, and the depth sensor."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from dyfn_core.adaptation.recording import FEWEST, SparseFrames
from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.geometry.l1_fit import fit_scale_shift
from dyfn_core.models.base import GeometryModel, Latent
from dyfn_core.prediction import StreamState
from dyfn_core.scoring.protocols import SequenceScorer
from dyfn_core.scoring.variants import VariantScore
from dyfn_core.stream.depth_stream import DepthStream


@dataclass(frozen=True)
class HeldBackScore:
    """AbsRel of one model on some frames of one recording.

    Attributes:
        points_image: Of the triangulated points, weighted, each frame aligned by itself.
        points_video: The same under one alignment for all frames.
        truth: Of the depth sensor, on a grid of pixels; None where nothing was recorded.
    """

    points_image: float
    points_video: float
    truth: VariantScore | None


def score_frames(
    model: GeometryModel, frames: SparseFrames, chosen: Sequence[int]
) -> HeldBackScore:
    """Run the whole stream, as it would run live, and score some of its frames.

    Args:
        model: With or without DyFN.
        frames: The recording.
        chosen: Frames that are scored, rising.
    """
    points, truth = PointScorer(), SequenceScorer()
    for index, depth in predictions(model, frames, chosen):
        points.push(
            at_points(depth[None], frames.place[index][None])[0].numpy(),
            frames.depth[index].numpy(),
            frames.weight[index].numpy(),
        )
        if frames.has_truth:
            truth.push(depth.numpy(), frames.truth[index].float().numpy())
    known = VariantScore.of(truth) if frames.has_truth else None
    return HeldBackScore(points.image(), points.video(), known)


@torch.inference_mode()
def predictions(
    model: GeometryModel, frames: SparseFrames, chosen: Sequence[int]
) -> Iterator[tuple[int, Tensor]]:
    """Depth H/2 x W/2 of the chosen frames, NaN where the model says nothing.

    DyFN sees every frame up to the last chosen one.
    """
    rows, columns = half = (frames.network_size[0] // 2, frames.network_size[1] // 2)
    camera = pixel_intrinsics(frames.camera, half)
    wanted, starts = set(chosen), set(frames.starts)
    state: StreamState | None = None
    stream = DepthStream(model, camera)
    for index in range(max(chosen, default=-1) + 1):
        if index in starts:
            state, stream = None, DepthStream(model, camera)
        features = frames.latent[index][None].to(model.device).float()
        latent = Latent(features, (rows, columns), frames.network_size)
        if model.stabilizer is not None:
            latent, state = model.stabilize_latent(latent, state)
        if index in wanted:
            found = stream.finish(model.decode(latent), state)
            yield index, torch.where(found.mask, found.depth, torch.nan).cpu()


def at_points(depth: Tensor, place: Tensor) -> Tensor:
    """Maps B x H x W at places B x P x 2 ((x, y) from -1 to 1), B x P; interpolated."""
    found = F.grid_sample(
        depth[:, None], place[:, None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return found[:, 0, 0]


class PointScorer:
    """The image and video protocols on sparse points with weights; every frame counts alike."""

    def __init__(self) -> None:
        self._frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def push(self, predicted: np.ndarray, depth: np.ndarray, weight: np.ndarray) -> None:
        """One frame; too few points are no frame.

        Args:
            predicted: P, NaN where nothing is predicted.
            depth: P, metres, NaN where there is no point.
            weight: P.
        """
        known = np.isfinite(predicted) & np.isfinite(depth) & (weight > 0)
        if known.sum() < FEWEST:
            return
        weight = weight[known] / weight[known].sum()
        self._frames.append((predicted[known], depth[known], weight))

    def image(self) -> float:
        """AbsRel with a scale and a shift for each frame; NaN without frames."""
        errors = [_error(*frame) for frame in self._frames]
        return float(np.mean(errors)) if errors else float("nan")

    def video(self) -> float:
        """AbsRel with one scale and shift for all frames; NaN without frames."""
        if not self._frames:
            return float("nan")
        predicted, depth, weight = (
            np.concatenate(part) for part in zip(*self._frames, strict=True)
        )
        return _error(predicted, depth, weight / len(self._frames))


def _error(predicted: np.ndarray, depth: np.ndarray, weight: np.ndarray) -> float:
    """sum w |s p + t - d| / d at its minimum over s and t; the weights' sum is 1."""
    scale, shift = fit_scale_shift(predicted, depth, weight / depth)
    return float((weight * np.abs(scale * predicted + shift - depth) / depth).sum())
