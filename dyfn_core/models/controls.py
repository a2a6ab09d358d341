"""What a learned DyFN is compared with: the latent's own statistics, averaged or frozen."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor

from dyfn_core.models.base import Affine, GeometryModel, Latent
from dyfn_core.models.dyfn import EMA_ALPHA, EPSILON, DyFN, DyFNConfig
from dyfn_core.prediction import StreamState


class StatisticsControl(DyFN):
    """Replaces the latent's statistics by a moving average of themselves; nothing is learned.

    alpha: weight of the present frame; 0 keeps the first frame's statistics, 1 changes nothing.
    """

    def __init__(self, channels: int, alpha: float) -> None:
        super().__init__(channels, DyFNConfig())
        if not 0 <= alpha <= 1:
            raise ValueError(f"alpha must be in 0..1, got {alpha}")
        self.alpha = alpha

    def gru_input(self, features: Tensor, mean: Tensor) -> Tensor:
        return mean

    def _step(
        self, gru_input: Tensor, mean: Tensor, std: Tensor, state: StreamState | None
    ) -> tuple[Tensor, Tensor, StreamState]:
        if state is not None and state.ema_mean is not None and state.ema_std is not None:
            mean = torch.lerp(state.ema_mean, mean, self.alpha)
            std = torch.lerp(state.ema_std, std, self.alpha)
        return std + EPSILON, mean, StreamState(mean, mean, std)


def ema_control(channels: int) -> StatisticsControl:
    """Moving average of mean and deviation, alpha 0.1."""
    return StatisticsControl(channels, EMA_ALPHA)


def frozen_control(channels: int) -> StatisticsControl:
    """Mean and deviation of the first frame for the whole stream."""
    return StatisticsControl(channels, 0.0)


def latent_controls(model: GeometryModel) -> dict[str, DyFN]:
    """What the model's own stabilizer is compared with, by name, on the model's device."""
    channels = model.latent_channels
    return {
        "ema": ema_control(channels).to(model.device),
        "frozen": frozen_control(channels).to(model.device),
    }


@contextlib.contextmanager
def stabilized_by(model: GeometryModel, stabilizer: DyFN | None) -> Iterator[GeometryModel]:
    """Inside, the model has this stabilizer (or none); afterwards its own again."""
    own = model.stabilizer
    model.stabilizer = stabilizer
    try:
        yield model
    finally:
        model.stabilizer = own


def decode_with(
    model: GeometryModel, stabilizer: DyFN | None, latent: Latent, state: StreamState | None
) -> tuple[Affine, StreamState | None]:
    """Decode a latent as if the model had this stabilizer.

    Args:
        model: encoder and decoder; its own stabilizer is not used.
        stabilizer: what changes the latent; None decodes it as it is.
        latent: of one frame.
        state: of this stabilizer after the frame before; None starts a stream.

    Returns:
        The decoder's output, up to scale and shift, and the state after this frame.
    """
    with stabilized_by(model, stabilizer):
        changed, state = model.stabilize_latent(latent, state)
    return model.decode(changed), state
