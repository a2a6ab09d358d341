"""DyFN: take the latent's statistics away, remember, put better ones back (paper, section 3)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dyfn_core.models.deterministic import DeterministicConv2d, DeterministicLinear, is_traced
from dyfn_core.prediction import StreamState

EPSILON = 1e-5
EMA_ALPHA = 0.1
KINDS = ("convgru", "gru")
FORMS = ("paper", "residual")


@dataclass(frozen=True)
class DyFNConfig:
    """Which DyFN.

    kind: "convgru" (the paper's) or "gru" (its ablation, on the pooled latent).
    hidden: channels of the hidden state; 256 in the released checkpoint.
    pool: the ConvGRU sees the latent averaged over pool x pool cells; 1 = as released.
    form: "paper": F' = sigma_t * F_norm + mu_t, statistics replaced by predicted ones;
        "residual": F' = sigma_F * exp(dg) * F_norm + (mu_F + sigma_F * db), statistics corrected,
        the identity before training.
    standardize: the recurrence sees every channel less its usual mean, over its usual deviation:
        constants of the checkpoint, zero and one until training sets them. For latents whose
        channels sit at very different levels.
    memory_only: residual corrections are those of the stream less those of a stream that begins
        at this frame. What one picture says about its scale is left to the base: the first frame
        is the base's, bit for bit, and only the past can change a later one.
    """

    kind: str = "convgru"
    hidden: int = 256
    pool: int = 1
    form: str = "paper"
    standardize: bool = False
    memory_only: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"stabilizer kind {self.kind!r} is unknown, expected one of {KINDS}")
        if self.form not in FORMS:
            raise ValueError(f"stabilizer form {self.form!r} is unknown, expected one of {FORMS}")
        if self.hidden < 1 or self.pool < 1:
            raise ValueError(
                f"stabilizer hidden ({self.hidden}) and pool ({self.pool}) must be at least 1"
            )
        if self.memory_only and self.form != "residual":
            raise ValueError(
                f"stabilizer memory_only needs the form 'residual', got form {self.form!r}"
            )

    def to_dict(self) -> dict[str, Any]:
        """The fields as JSON-able values."""
        return asdict(self)


def build_dyfn(channels: int, config: DyFNConfig) -> DyFN:
    """A fresh, untrained DyFN for a latent with that number of channels."""
    if config.kind == "gru":
        return GRUDyFN(channels, config)
    return ConvGRUDyFN(channels, config)


class DyFN(nn.Module, ABC):
    """What both variants share: statistics out, statistics in, both per channel."""

    def __init__(self, channels: int, config: DyFNConfig) -> None:
        super().__init__()
        self.channels = channels
        self.config = config
        if config.standardize:
            self.register_buffer("usual_mean", torch.zeros(channels))
            self.register_buffer("usual_std", torch.ones(channels))

    def forward(self, features: Tensor, state: StreamState | None) -> tuple[Tensor, StreamState]:
        """features B x C x h x w, previous state -> stabilized features, next state.

        state=None is the first frame: a zero hidden state. Float32 under autocast too: the
        statistics are the scale. Raises ValueError when the state belongs to another batch,
        another latent size or another kind of stabilizer.
        """
        kind = features.device.type
        if torch.is_autocast_enabled(kind):
            with torch.autocast(kind, enabled=False):
                return self.forward(features.float(), state)
        if features.shape[-2] * features.shape[-1] < 2:
            raise ValueError(
                f"a latent of {features.shape[-2]} x {features.shape[-1]} cells has no standard "
                "deviation; use a larger image or more tokens"
            )
        gamma, beta, mean, std, state = self.statistics(features, state)
        if self.config.form == "residual":
            # Written so that gamma = beta = 0 is the identity to rounding, without epsilon.
            scale, offset = gamma.exp(), mean + std * beta
        else:
            scale, offset = gamma / (std + EPSILON), beta
        shift = offset - scale * mean
        return torch.addcmul(shift[..., None, None], features, scale[..., None, None]), state

    def statistics(
        self, features: Tensor, state: StreamState | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, StreamState]:
        """features -> (gamma, beta, mean, std), each B x C, and the next state.

        "paper" form: gamma, beta are the statistics to apply (sigma_t, mu_t). "residual" form:
        they are the corrections (dg, db). mean, std are the latent's own.
        """
        std, mean = torch.std_mean(features, dim=(-2, -1))
        gamma, beta, state = self.remember(features, mean, std, state)
        return gamma, beta, mean, std, state

    def remember(
        self, features: Tensor, mean: Tensor, std: Tensor, state: StreamState | None
    ) -> tuple[Tensor, Tensor, StreamState]:
        """One step of the recurrence -> gamma, beta (B x C), next state."""
        return self.recur(self.gru_input(features, mean), mean, std, state)

    @abstractmethod
    def gru_input(self, features: Tensor, mean: Tensor) -> Tensor:
        """What the recurrence sees of a latent: B x C, or B x C x h' x w'."""

    def recur(
        self, gru_input: Tensor, mean: Tensor, std: Tensor, state: StreamState | None
    ) -> tuple[Tensor, Tensor, StreamState]:
        """As remember, from what `gru_input` gives; the residual form does not use mean and std."""
        gamma, beta, after = self._step(gru_input, mean, std, state)
        if not self.config.memory_only:
            return gamma, beta, after
        if state is None:
            return torch.zeros_like(gamma), torch.zeros_like(beta), after
        alone_gamma, alone_beta, _ = self._step(gru_input, mean, std, None)
        return gamma - alone_gamma, beta - alone_beta, after

    @abstractmethod
    def _step(
        self, gru_input: Tensor, mean: Tensor, std: Tensor, state: StreamState | None
    ) -> tuple[Tensor, Tensor, StreamState]:
        """gamma and beta (B x C) of the hidden state after this frame, and the next state."""

    def standardized(self, gru_input: Tensor) -> Tensor:
        """The input in units of its usual values, when the config asks for that."""
        if not self.config.standardize:
            return gru_input
        mean, std = self.get_buffer("usual_mean"), self.get_buffer("usual_std")
        shape = (1, -1) + (1,) * (gru_input.dim() - 2)
        return (gru_input - mean.view(shape)) / std.view(shape)

    def _previous(self, shape: tuple[int, ...], state: StreamState | None, like: Tensor) -> Tensor:
        if state is None:
            return like.new_zeros(shape)
        if tuple(state.hidden.shape) != shape:
            raise ValueError(
                f"the state is of shape {tuple(state.hidden.shape)}, this frame needs {shape}: "
                "another image size, batch or model; start the stream anew with state=None"
            )
        return state.hidden


class ConvGRUCell(nn.Module):
    """A gated recurrent unit whose gates are 3 x 3 convolutions with zero padding."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.conv_gates = DeterministicConv2d(channels + hidden, 2 * hidden, 3, padding=1)
        self.conv_candidate = DeterministicConv2d(channels + hidden, hidden, 3, padding=1)

    def forward(self, x: Tensor, hidden: Tensor) -> Tensor:
        """x B x C x h x w, hidden B x D x h x w -> next hidden, same shape."""
        gates = torch.sigmoid(self.conv_gates(torch.cat([x, hidden], dim=1)))
        reset, update = gates.chunk(2, dim=1)
        candidate = torch.tanh(self.conv_candidate(torch.cat([x, reset * hidden], dim=1)))
        return torch.lerp(hidden, candidate, update)


class ConvGRUDyFN(DyFN):
    """The paper's DyFN: h_t = ConvGRU(F_t, h_{t-1}), statistics from 1 x 1 heads, pooled."""

    def __init__(self, channels: int, config: DyFNConfig) -> None:
        super().__init__(channels, config)
        self.conv_gru_cell = ConvGRUCell(channels, config.hidden)
        self.gamma_head = DeterministicConv2d(config.hidden, channels, 1)
        self.beta_head = DeterministicConv2d(config.hidden, channels, 1)
        nn.init.zeros_(self.gamma_head.weight)
        nn.init.zeros_(self.beta_head.weight)
        nn.init.constant_(self.gamma_head.bias, 1.0 if config.form == "paper" else 0.0)  # type: ignore[arg-type]
        nn.init.zeros_(self.beta_head.bias)  # type: ignore[arg-type]

    def _step(
        self, gru_input: Tensor, mean: Tensor, std: Tensor, state: StreamState | None
    ) -> tuple[Tensor, Tensor, StreamState]:
        x = self.standardized(gru_input)
        shape = (x.shape[0], self.config.hidden, x.shape[2], x.shape[3])
        hidden = self.conv_gru_cell(x, self._previous(shape, state, x))
        average = hidden.mean(dim=(-2, -1), keepdim=True)
        # A 1 x 1 convolution of the average is the average of the convolution: only softplus
        # has to see every cell.
        beta = self.beta_head(average).flatten(1)
        if self.config.form == "residual":
            gamma = self.gamma_head(average).flatten(1)
        else:
            gamma = F.softplus(self.gamma_head(hidden)).mean(dim=(-2, -1))
        return gamma, beta, StreamState(hidden)

    def gru_input(self, features: Tensor, mean: Tensor) -> Tensor:
        pool = self.config.pool
        if pool == 1:
            return features
        height, width = int(features.shape[-2]), int(features.shape[-1])
        size = (math.ceil(height / pool), math.ceil(width / pool))
        if not is_traced():
            return F.adaptive_avg_pool2d(features, size)
        if height % size[0] == 0 and width % size[1] == 0:
            return F.avg_pool2d(features, (height // size[0], width // size[1]))
        rows, columns = _windows(height, size[0]), _windows(width, size[1])
        return rows.to(features) @ features @ columns.to(features).mT


class GRUDyFN(DyFN):
    """The paper's ablation: a GRU on the pooled latent corrects a moving average (alpha 0.1).

    The moving average lives in the stream's state, not in the module.
    """

    def __init__(self, channels: int, config: DyFNConfig) -> None:
        super().__init__(channels, config)
        self.gru_cell = nn.GRUCell(channels, config.hidden)
        self.gamma_delta_head = DeterministicLinear(config.hidden, channels)
        self.beta_delta_head = DeterministicLinear(config.hidden, channels)
        for head in (self.gamma_delta_head, self.beta_delta_head):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def gru_input(self, features: Tensor, mean: Tensor) -> Tensor:
        return mean

    def _step(
        self, gru_input: Tensor, mean: Tensor, std: Tensor, state: StreamState | None
    ) -> tuple[Tensor, Tensor, StreamState]:
        x = self.standardized(gru_input)
        shape = (x.shape[0], self.config.hidden)
        hidden = self.gru_cell(x, self._previous(shape, state, x))
        gamma, beta = self.gamma_delta_head(hidden), self.beta_delta_head(hidden)
        if self.config.form == "residual":
            return gamma, beta, StreamState(hidden)
        ema_mean = _moving_average(None if state is None else state.ema_mean, mean.detach())
        ema_std = _moving_average(None if state is None else state.ema_std, std.detach())
        gamma = (ema_std + gamma).clamp(min=EPSILON)
        return gamma, ema_mean + beta, StreamState(hidden, ema_mean, ema_std)


def _windows(length: int, count: int) -> Tensor:
    """The averages that adaptive pooling takes along one side, as a matrix count x length."""
    matrix = torch.zeros(count, length)
    for index in range(count):
        first, last = index * length // count, -(-(index + 1) * length // count)
        matrix[index, first:last] = 1 / (last - first)
    return matrix


def _moving_average(previous: Tensor | None, now: Tensor) -> Tensor:
    if previous is None:
        return now
    blended = EMA_ALPHA * now + (1 - EMA_ALPHA) * previous
    return torch.where(previous.isnan(), now, blended)
