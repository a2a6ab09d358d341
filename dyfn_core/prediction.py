"""The words that everything else is said in: Frame, StreamState, Prediction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

DEPTH, DISPARITY = "depth", "disparity"


@dataclass(frozen=True)
class Frame:
    """One camera image as it enters a stream.

    image: H x W x 3 uint8, RGB.
    stamp: seconds; None when the source has no clock.
    camera_matrix: 3 x 3 float64 intrinsics in pixels; None when unknown.
    """

    image: np.ndarray
    stamp: float | None = None
    camera_matrix: np.ndarray | None = None


@dataclass(frozen=True)
class StreamState:
    """What the recurrence remembers between two frames; a value, never mutated.

    hidden: hidden state h_t. ConvGRU: B x C x h x w, GRU: B x C.
    ema_mean, ema_std: B x C, only for the GRU variant, whose statistics are an
        exponential moving average; NaN in a row that has no history yet.
    """

    hidden: Tensor
    ema_mean: Tensor | None = None
    ema_std: Tensor | None = None

    @staticmethod
    def stack(states: Sequence[StreamState | None]) -> StreamState | None:
        """States of several streams -> the state of their batch, in the same order.

        A None (a stream at its first frame) becomes what None means: a zero hidden state and
        no history. All None gives None. Raises ValueError when the shapes differ.
        """
        known = [state for state in states if state is not None]
        if not known:
            return None
        shapes = {tuple(state.hidden.shape[1:]) for state in known}
        if len(shapes) > 1:
            raise ValueError(f"states of different shapes make no batch: {sorted(shapes)}")
        fresh = known[0]._without_history()
        rows = [fresh if state is None else state for state in states]
        return StreamState(
            torch.cat([row.hidden for row in rows]),
            _cat([row.ema_mean for row in rows]),
            _cat([row.ema_std for row in rows]),
        )

    def unbind(self) -> list[StreamState]:
        """The state of a batch of B streams -> B states of one stream each."""
        hidden = self.hidden.split(1)
        none: list[Tensor | None] = [None] * len(hidden)
        means = none if self.ema_mean is None else list(self.ema_mean.split(1))
        stds = none if self.ema_std is None else list(self.ema_std.split(1))
        return [StreamState(*row) for row in zip(hidden, means, stds, strict=True)]

    def to(self, device: torch.device | str) -> StreamState:
        """The same state on another device."""
        return StreamState(
            self.hidden.to(device),
            None if self.ema_mean is None else self.ema_mean.to(device),
            None if self.ema_std is None else self.ema_std.to(device),
        )

    def _without_history(self) -> StreamState:
        def blank(like: Tensor | None) -> Tensor | None:
            return None if like is None else torch.full_like(like[:1], float("nan"))

        return StreamState(
            torch.zeros_like(self.hidden[:1]), blank(self.ema_mean), blank(self.ema_std)
        )


def _cat(rows: Sequence[Tensor | None]) -> Tensor | None:
    known = [row for row in rows if row is not None]
    return torch.cat(known) if known else None


@dataclass(frozen=True)
class Prediction:
    """Geometry of one image (or a batch: every field then has a leading B).

    points: H x W x 3 float32, optical frame (x right, y down, z forward), up to scale.
    depth: H x W float32, z of the points, up to scale; +inf where the mask is False.
    mask: H x W bool, True where the prediction is valid.
    intrinsics: 3 x 3 float32, normalised: pixel x = (u + 0.5) / W, y = (v + 0.5) / H.
    state: goes into the next call of the same stream; None for a model without stabilizer.
    quantity: what the model predicts. "depth": depth is right up to one scale. "disparity": the
        model's output is `disparity`, right up to scale and shift; depth is its inverse under the
        assumption that the shift is 0, so compare with truth by aligning `disparity` with 1 / z.
    disparity: H x W float32, >= 0, only for quantity "disparity".
    """

    points: Tensor
    depth: Tensor
    mask: Tensor
    intrinsics: Tensor
    state: StreamState | None = None
    quantity: str = DEPTH
    disparity: Tensor | None = None
