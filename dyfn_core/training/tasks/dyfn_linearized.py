"""The linearized method: DyFN's recurrence learns the scale error of every frame, undecoded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyfn_core.losses.scale_spread import spread
from dyfn_core.losses.video_protocol import video_protocol_loss
from dyfn_core.prediction import StreamState
from dyfn_core.training.config import ConfigError
from dyfn_core.training.dyfn_config import DyFNRunConfig, LinearizedMethod
from dyfn_core.training.loop.processes import part_seed, share_of
from dyfn_core.training.tasks.dyfn import DyFNTask
from dyfn_core.training.tasks.gru_input_cache import GRUInputCache, GRUInputClips
from dyfn_core.training.tasks.latent_cache import LatentClips
from dyfn_core.training.tasks.validation import Sequence


class LinearizedTask(DyFNTask):
    """DyFN in residual form, trained on the inputs of its recurrence with the decoder linearized.

    A frame whose statistics are corrected by gamma and beta has, to first order, the scale error
    e + slope . (gamma, beta), with a slope of its own, and its depth is the base's times the
    exponential of that product. The loss is the spread of these errors within a clip, the video
    protocol's error of sampled depths, and a share of the errors' size and of the corrections'.
    Judged, like every DyFN, with the real decoder.

    Raises ConfigError when DyFN is not of the residual form.
    """

    def __init__(
        self, config: DyFNRunConfig, cache_folder: Path, device: torch.device | str = "cpu"
    ) -> None:
        if not isinstance(config.method, LinearizedMethod):
            raise ConfigError(f"method.kind: expected 'linearized', got {config.method.kind!r}")
        super().__init__(config, device)
        self.method = method = config.method
        if self.dyfn.config.form != "residual":
            raise ConfigError(
                "dyfn.form: method 'linearized' needs the form 'residual', got "
                f"{self.dyfn.config.form!r}"
            )
        self.cache = GRUInputCache(
            method.cache or cache_folder,
            self.model,
            self.source,
            method.gru_input_draws,
            self.unreadable,
        )
        if self.dyfn.config.standardize and not config.warm_start:
            mean, std = self.cache.usual()
            self.dyfn.get_buffer("usual_mean").copy_(mean)
            self.dyfn.get_buffer("usual_std").copy_(std)

    def batches(self, start: int, part: int = 0, parts: int = 1) -> Iterator[GRUInputClips]:
        clips = share_of(self.method.clips, parts, "clips")
        seed = part_seed(self.config.seed, part)
        return self.cache.batches(start, seed, clips, self.method.length, self.method.sub_strides)

    def images(self, batch: GRUInputClips) -> int:
        return batch.error.numel()

    def loss(self, batch: GRUInputClips) -> tuple[Tensor, dict[str, float]]:
        batch = batch.to(self.model.device)
        change = self._corrections(batch.gru_input.float())
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
        weights = self.method.weights()
        total = torch.stack([weights[name] * term for name, term in terms.items()]).sum()
        values = {name: float(term.detach()) for name, term in terms.items()}
        values["base_spread"] = float(spread(before, seen.float()))
        values["base_video"] = float(video_protocol_loss(batch.depth, batch.truth))
        return total, {"loss": float(total.detach()), **values}

    def _corrections(self, gru_input: Tensor) -> Tensor:
        """B x T x C (x h x w) -> gamma and beta of every frame, B x T x 2C."""
        noise = self.method.noise
        if noise > 0:
            usual = gru_input.flatten(0, 1).std(0, keepdim=True).unsqueeze(0)
            shape = (len(gru_input), 1, gru_input.shape[2])
            constant = torch.randn(*shape, device=gru_input.device)
            constant = constant.view(*shape, *(1,) * (gru_input.dim() - 3))
            gru_input = gru_input + noise * usual * (torch.randn_like(gru_input) + 0.5 * constant)
        state: StreamState | None = None
        outputs = []
        empty = gru_input.new_zeros(())
        for frame in gru_input.unbind(1):
            gamma, beta, state = self.dyfn.recur(frame, empty, empty, state)
            outputs.append(torch.cat([gamma, beta], -1))
        return torch.stack(outputs, 1)

    def picture(self, batch: GRUInputClips) -> np.ndarray:
        """The frames of a validation clip: true depth, base and DyFN."""
        return self.clip_picture(_as_clips(self.sequences["rendered"][0]))


def _as_clips(sequence: Sequence) -> LatentClips:
    intrinsics = torch.zeros(1, len(sequence.latent), 4)
    return LatentClips(
        sequence.latent[None],
        sequence.depth[None],
        intrinsics,
        sequence.image_size,
        sequence.network_size,
    )
