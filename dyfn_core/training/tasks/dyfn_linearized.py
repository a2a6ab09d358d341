"""Teaching DyFN's recurrence the scale error of every frame: the oracle's correction, distilled."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyfn_core.losses.scale_spread import spread
from dyfn_core.losses.video_protocol import video_protocol_loss
from dyfn_core.prediction import StreamState
from dyfn_core.training.config import ConfigError, ScaleRunConfig
from dyfn_core.training.loop.processes import part_seed, share_of
from dyfn_core.training.tasks.dyfn_unrolled import StabilizerTask
from dyfn_core.training.tasks.gru_input_cache import GRUInputCache, GRUInputClips
from dyfn_core.training.tasks.latent_cache import LatentClips
from dyfn_core.training.tasks.validation import Sequence


class ScaleTask(StabilizerTask):
    """DyFN in residual form, trained on summaries with the decoder linearised.

    A frame whose statistics are corrected by gamma and beta has, to first order, the scale error
    e + slope . (gamma, beta), with a slope of its own, and its depth is the base's times the
    exponential of that product. The loss is the spread of these errors within a clip, the video
    protocol's error of sampled depths, and a share of the errors' size and of the corrections'.
    Judged, like every DyFN, with the real decoder.
    """

    config: ScaleRunConfig

    def __init__(
        self, config: ScaleRunConfig, cache_folder: Path, device: torch.device | str = "cpu"
    ) -> None:
        super().__init__(config, cache_folder, device)
        stabilizer = self.model.stabilizer
        assert stabilizer is not None
        if stabilizer.config.form != "residual":
            raise ConfigError(
                "stabilizer.form: corrections of the scale need the form 'residual', got "
                f"{stabilizer.config.form!r}"
            )
        self.summaries = GRUInputCache(
            config.cache or cache_folder,
            self.model,
            self.source,
            config.summary_draws,
            self.unreadable,
        )
        if stabilizer.config.standardize and not config.warm_start:
            mean, std = self.summaries.usual()
            stabilizer.get_buffer("usual_mean").copy_(mean)
            stabilizer.get_buffer("usual_std").copy_(std)

    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[GRUInputClips]:  # type: ignore[override]
        clips = share_of(self.config.clips, parts, "clips")
        seed = part_seed(self.config.seed, part)
        return self.summaries.batches(
            start, seed, clips, self.config.length, self.config.sub_strides
        )

    def images(self, batch: GRUInputClips) -> int:  # type: ignore[override]
        return batch.error.numel()

    def loss(self, batch: GRUInputClips) -> tuple[Tensor, dict[str, float]]:  # type: ignore[override]
        batch = batch.to(self.model.device)
        change = self._corrections(batch.summary.float())
        moved = (change * batch.slope.float()).sum(-1)
        seen = torch.isfinite(batch.error)
        error = torch.where(seen, batch.error + moved, 0.0)
        before = torch.where(seen, batch.error, 0.0)
        terms = {
            "spread": spread(error, seen.float()),
            "video": video_protocol_loss(batch.depth * moved.exp()[..., None], batch.truth),
            "size": error.abs().sum() / seen.sum().clamp(min=1),
            "change": change.square().mean(),
        }
        weights = {
            "spread": self.config.spread_weight,
            "video": self.config.video_weight,
            "size": self.config.size_weight,
            "change": self.config.change_weight,
        }
        total = torch.stack([weights[name] * term for name, term in terms.items()]).sum()
        values = {name: float(term.detach()) for name, term in terms.items()}
        values["base_spread"] = float(spread(before, seen.float()))
        values["base_video"] = float(video_protocol_loss(batch.depth, batch.truth))
        return total, {"loss": float(total.detach()), **values}

    def _corrections(self, summary: Tensor) -> Tensor:
        """B x T x C (x h x w) -> gamma and beta of every frame, B x T x 2C."""
        stabilizer = self.model.stabilizer
        assert stabilizer is not None
        noise = self.config.noise
        if noise > 0:
            usual = summary.flatten(0, 1).std(0, keepdim=True).unsqueeze(0)
            constant = torch.randn(summary.shape[0], 1, summary.shape[2], device=summary.device)
            constant = constant.view(*constant.shape, *(1,) * (summary.dim() - 3))
            summary = summary + noise * usual * (torch.randn_like(summary) + 0.5 * constant)
        state: StreamState | None = None
        outputs = []
        empty = summary.new_zeros(())
        for frame in summary.unbind(1):
            gamma, beta, state = stabilizer.recur(frame, empty, empty, state)
            outputs.append(torch.cat([gamma, beta], -1))
        return torch.stack(outputs, 1)

    def picture(self, batch: GRUInputClips) -> np.ndarray:  # type: ignore[override]
        """The frames of a validation clip: true depth, base and DyFN."""
        sequence = self.sequences["rendered"][0]
        return super().picture(_as_clips(sequence))


def _as_clips(sequence: Sequence) -> LatentClips:
    intrinsics = torch.zeros(1, len(sequence.latent), 4)
    return LatentClips(
        sequence.latent[None],
        sequence.depth[None],
        intrinsics,
        sequence.image_size,
        sequence.network_size,
    )
