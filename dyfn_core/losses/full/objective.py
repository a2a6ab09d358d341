"""The whole objective for point maps: every term on its own, weighted, switched off by weight 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyfn_core.losses.clip_alignment import ClipTarget, align_clips_fully, clip_alignment_loss
from dyfn_core.losses.local import RELEASED_LEVELS, TEXT_LEVELS, LocalLevel, ball_loss
from dyfn_core.losses.mask import mask_pixel_loss
from dyfn_core.losses.normal import corner_normal_loss, edge_loss
from dyfn_core.losses.temporal import released_temporal_loss, temporal_loss, window_pairs
from dyfn_core.losses.whole_frame import align_frames_fully, aligned_frame_loss

FORMS = ("text", "released")


@dataclass(frozen=True)
class Objective:
    """Weights of the terms (a term of weight 0 is not computed) and what shapes them.

    align_first, align_all: L_align under the alignment of the first frame or of all. frame: MoGe's
    per-frame global term. local: L_local, of each level. normal, mask, edge: MoGe's. temporal:
    L_temp. form: "text" (motion in magnitude, errors averaged over what is valid) or "released"
    (motion vectors, errors averaged over all pixels and coordinates, and the temporal term
    averaged with the frames' losses as one more of them).
    resolution, all_resolution: grids of the alignments of one frame and of all frames.
    """

    align_first: float = 1.0
    align_all: float = 0.0
    frame: float = 1.0
    local: float = 1.0
    normal: float = 1.0
    mask: float = 1.0
    edge: float = 0.0
    temporal: float = 0.1
    form: str = "text"
    levels: tuple[LocalLevel, ...] = TEXT_LEVELS
    windows: tuple[int, ...] = (1, 2, 4)
    resolution: int = 32
    all_resolution: int = 8

    def __post_init__(self) -> None:
        if self.form not in FORMS:
            raise ValueError(f"objective form {self.form!r} is unknown, expected one of {FORMS}")

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> Objective:
        """From plain values, `levels` being mappings of LocalLevel's fields."""
        plain: dict[str, Any] = {
            key: tuple(v) if isinstance(v, list) else v for key, v in values.items()
        }
        if "levels" in plain:
            plain["levels"] = tuple(
                level if isinstance(level, LocalLevel) else LocalLevel(**level)
                for level in plain["levels"]
            )
        return Objective(**plain)

    def weights(self) -> dict[str, float]:
        """Weight of each term that counts, by name; local levels are "local_0", "local_1", ..."""
        single = ("align_first", "align_all", "frame", "normal", "mask", "edge", "temporal")
        found = {name: getattr(self, name) for name in single}
        found |= {f"local_{i}": self.local for i in range(len(self.levels))}
        return {name: weight for name, weight in found.items() if weight > 0}

    def terms(
        self,
        points: Tensor,
        mask: Tensor,
        target: ClipTarget,
        anchors: Mapping[LocalLevel, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """Every term that counts, unweighted, by name.

        points: B x T x H x W x 3; mask: B x T x H x W raw. anchors: the local term's anchors by
        level, (B * T) x A flat pixel indices; drawn with torch's generator where absent.
        """
        flat, frames = points.flatten(0, 1), target.frames
        wanted = self.weights()
        terms = {}
        first = None
        if {"align_first", "temporal"} & set(wanted):
            first = align_clips_fully(points, target, "first", self.resolution)
        if first is not None and "align_first" in wanted:
            terms["align_first"] = self._clips(points, target, *first)
        if "align_all" in wanted:
            every = align_clips_fully(points, target, "all", self.all_resolution)
            terms["align_all"] = self._clips(points, target, *every)
        own = None
        if "frame" in wanted or (self.local > 0 and self.levels):
            own = align_frames_fully(flat, frames, self.resolution)
        if own is not None and "frame" in wanted:
            terms["frame"] = aligned_frame_loss(flat, frames, *own).mean()
        if own is not None and self.local > 0:
            for i, level in enumerate(self.levels):
                given = None if anchors is None else anchors.get(level)
                terms[f"local_{i}"] = ball_loss(flat, frames, level, own[0], given).mean()
        if "normal" in wanted:
            terms["normal"] = corner_normal_loss(flat, frames).mean()
        if "edge" in wanted:
            terms["edge"] = edge_loss(flat, frames).mean()
        if "mask" in wanted:
            terms["mask"] = mask_pixel_loss(mask.flatten(0, 1), frames).mean()
        if first is not None and "temporal" in wanted:
            terms["temporal"] = self._temporal(points, target, first[0])
        return terms

    def _clips(self, points: Tensor, target: ClipTarget, scale: Tensor, shift: Tensor) -> Tensor:
        if self.form == "text":
            return clip_alignment_loss(points, target, scale, shift)
        frames = target.length
        return aligned_frame_loss(
            points.flatten(0, 1),
            target.frames,
            scale.repeat_interleave(frames),
            shift.repeat_interleave(frames, dim=0),
        ).mean()

    def _temporal(self, points: Tensor, target: ClipTarget, scale: Tensor) -> Tensor:
        if self.form == "released":
            return released_temporal_loss(points, target, scale, self.windows)
        pairs = window_pairs(range(target.length), self.windows)
        return temporal_loss(points, target, scale, pairs)

    def total(self, terms: Mapping[str, Tensor], frames: int | None = None) -> Tensor:
        """The weighted sum. frames: of the whole batch, for form "released"; see there."""
        weights = self.weights()
        parts = {name: weights[name] * term for name, term in terms.items()}
        if self.form == "text" or "temporal" not in parts:
            return torch.stack(list(parts.values())).sum()
        if frames is None:
            raise ValueError("the released total needs the number of frames in the batch")
        temporal = parts.pop("temporal")
        others = torch.stack(list(parts.values())).sum() if parts else torch.zeros_like(temporal)
        return (frames * others + temporal) / (frames + 1)


def released_objective() -> Objective:
    """What the released training script minimises for synthetic data."""
    return Objective(form="released", levels=RELEASED_LEVELS, windows=(1, 2, 4, 8))
