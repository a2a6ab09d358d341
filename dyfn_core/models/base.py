"""What every geometry model is: encode, (stabilize), decode around one latent."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor, nn

from dyfn_core.prediction import StreamState


@dataclass(frozen=True)
class Latent:
    """The feature map F_t and what the decoder must know about the image it came from.

    features: B x C x h x w.
    image_size: (H, W) of the caller's image, the size that points come out at.
    network_size: (H, W) of the resized image that the decoder works at.
    """

    features: Tensor
    image_size: tuple[int, int]
    network_size: tuple[int, int]


@dataclass(frozen=True)
class AffinePoints:
    """An affine-invariant point map: true up to one scale and one shift along z.

    points: B x H x W x 3, after the model's remap (exp: z > 0, x and y proportional to z).
    mask: B x H x W, raw mask output; valid where it exceeds the model's mask threshold.
    """

    points: Tensor
    mask: Tensor


class GeometryModel(nn.Module, ABC):
    """An encoder and a decoder around one latent, with DyFN in between.

    stabilizer: the DyFN module, or None for a plain base model.
    """

    mask_threshold: float = 0.5
    stabilizer: nn.Module | None = None

    @abstractmethod
    def encode(self, image: Tensor, num_tokens: int | None = None) -> Latent:
        """image: B x 3 x H x W float RGB in 0..1 -> Latent."""

    @abstractmethod
    def decode(self, latent: Latent) -> AffinePoints:
        """Latent -> affine-invariant points at latent.image_size."""

    def stabilize(
        self, features: Tensor, state: StreamState | None
    ) -> tuple[Tensor, StreamState | None]:
        """features B x C x h x w, previous state -> stabilized features, next state."""
        if self.stabilizer is None:
            return features, None
        return self.stabilizer(features, state)
