"""The whole objective for point maps: every term on its own, weighted, switched off by weight 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyfn_core.losses.clip_alignment import clip_alignment_loss
from dyfn_core.losses.full.clip_alignment import align_clips
from dyfn_core.losses.full.local import RELEASED_LEVELS, TEXT_LEVELS, LocalLevel, local_loss
from dyfn_core.losses.full.mask import mask_loss
from dyfn_core.losses.full.normal import edge_loss, normal_loss
from dyfn_core.losses.full.temporal import FORMS, temporal_loss
from dyfn_core.losses.full.whole_frame import align_frames, global_loss
from dyfn_core.losses.target import ClipTarget

# Where the released training code differs from the text, beside the form of its terms.
RELEASED: dict[str, Any] = {"frame": 1.0, "levels": RELEASED_LEVELS, "windows": (1, 2, 4, 8)}


@dataclass(frozen=True)
class Objective:
    """L = L_MoGe + 1.0 L_align + 0.1 L_temp (paper section 4).

    L_MoGe = L_local + L_normal + L_mask. The released code keeps MoGe's L_global besides
    (RELEASED). A term of weight 0 is not computed.

    Attributes:
        align_first: Weight of L_align under the alignment of the first frame.
        align_all: Weight of L_align under the alignment of all frames.
        frame: Weight of MoGe's per-frame global term, which the paper's text does not have.
        local: Weight of L_local, of each level.
        normal: Weight of L_normal.
        mask: Weight of L_mask.
        edge: Weight of MoGe's edge term, which is no part of the paper's objective.
        temporal: Weight of L_temp.
        form: "text" (motion in magnitude, errors averaged over what is valid) or "released" (motion
            vectors, errors averaged over all pixels and coordinates, and the temporal term averaged
            with the frames' losses as one more of them).
        levels: Of L_local.
        windows: Distances k of L_temp, in frames.
        resolution: Side of the grid that one frame is aligned on.
        all_resolution: Side of the grid of each frame when all are aligned at once.
    """

    align_first: float = 1.0
    align_all: float = 0.0
    frame: float = 0.0
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
        """Make an objective from plain values.

        Args:
            values: Fields of Objective; `levels` may be mappings of LocalLevel's fields. With form
                "released", absent ones are those of RELEASED.

        Returns:
            The objective.

        Raises:
            ValueError: For an unknown form.
            TypeError: For an unknown field.
        """
        plain: dict[str, Any] = {
            key: tuple(v) if isinstance(v, list) else v for key, v in values.items()
        }
        if "levels" in plain:
            plain["levels"] = tuple(
                level if isinstance(level, LocalLevel) else LocalLevel(**level)
                for level in plain["levels"]
            )
        return Objective(**(RELEASED if plain.get("form") == "released" else {}) | plain)

    def check_size(self, size: tuple[int, int]) -> None:
        """Refuse images too small for the levels of L_local.

        Args:
            size: Height and width that the losses are computed at, in pixels.

        Raises:
            ValueError: Names the level and the smallest size.
        """
        for level in self.levels if self.local > 0 else ():
            level.check_size(size)

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
        """Compute every term that counts, unweighted.

        Args:
            points: Predicted points, B x T x H x W x 3.
            mask: Raw mask output, B x T x H x W.
            target: The true geometry of the clips.
            anchors: Anchors of L_local by level, flat pixel indices (B * T) x A; drawn with
                torch's generator where absent.

        Returns:
            Terms by name, as in `weights`.
        """
        flat, frames = points.flatten(0, 1), target.frames
        wanted = self.weights()
        terms = {}
        own = first = None
        if "frame" in wanted or (self.local > 0 and self.levels):
            own = align_frames(flat, frames, self.resolution)
        if {"align_first", "temporal"} & set(wanted):
            if own is None:
                first = align_clips(points, target, "first", self.resolution)
            else:  # the first frame's own alignment
                first = own[0][:: target.length], own[1][:: target.length]
        if first is not None and "align_first" in wanted:
            terms["align_first"] = self._clips(points, target, *first)
        if "align_all" in wanted:
            every = align_clips(points, target, "all", self.all_resolution)
            terms["align_all"] = self._clips(points, target, *every)
        if own is not None and "frame" in wanted:
            terms["frame"] = global_loss(flat, frames, *own).mean()
        if own is not None and self.local > 0:
            for i, level in enumerate(self.levels):
                given = None if anchors is None else anchors.get(level)
                terms[f"local_{i}"] = local_loss(flat, frames, own[0], level, given).mean()
        if "normal" in wanted:
            terms["normal"] = normal_loss(flat, frames).mean()
        if "edge" in wanted:
            terms["edge"] = edge_loss(flat, frames).mean()
        if "mask" in wanted:
            terms["mask"] = mask_loss(mask.flatten(0, 1), frames).mean()
        if first is not None and "temporal" in wanted:
            terms["temporal"] = temporal_loss(points, target, first[0], self.windows, self.form)
        return terms

    def _clips(self, points: Tensor, target: ClipTarget, scale: Tensor, shift: Tensor) -> Tensor:
        if self.form == "text":
            return clip_alignment_loss(points, target, scale, shift)
        frames = target.length
        return global_loss(
            points.flatten(0, 1),
            target.frames,
            scale.repeat_interleave(frames),
            shift.repeat_interleave(frames, dim=0),
        ).mean()

    def total(self, terms: Mapping[str, Tensor], frames: int | None = None) -> Tensor:
        """Add the terms up.

        Args:
            terms: As `terms` gives them.
            frames: Number of frames of the whole batch, B * T; form "released" needs it.

        Returns:
            The weighted sum; with form "released" (frames * others + temporal) / (frames + 1).

        Raises:
            ValueError: If form "released" is not told the number of frames.
        """
        weights = self.weights()
        parts = {name: weights[name] * term for name, term in terms.items()}
        if self.form == "text" or "temporal" not in parts:
            return torch.stack(list(parts.values())).sum()
        if frames is None:
            raise ValueError("the released total needs the number of frames in the batch")
        temporal = parts.pop("temporal")
        others = torch.stack(list(parts.values())).sum() if parts else torch.zeros_like(temporal)
        return (frames * others + temporal) / (frames + 1)
