"""The words that everything else is said in: Frame, StreamState, Prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor


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
        exponential moving average.
    """

    hidden: Tensor
    ema_mean: Tensor | None = None
    ema_std: Tensor | None = None


@dataclass(frozen=True)
class Prediction:
    """Geometry of one image (or a batch: every field then has a leading B).

    points: H x W x 3 float32, optical frame (x right, y down, z forward), up to scale.
    depth: H x W float32, z of the points, up to scale; +inf where the mask is False.
    mask: H x W bool, True where the prediction is valid.
    intrinsics: 3 x 3 float32, normalised: pixel x = (u + 0.5) / W, y = (v + 0.5) / H.
    state: goes into the next call of the same stream; None for a model without stabilizer.
    """

    points: Tensor
    depth: Tensor
    mask: Tensor
    intrinsics: Tensor
    state: StreamState | None = None
