"""Depth Anything 3, mono and metric: a DINOv2 encoder and a DPT head, depth without a camera.

The two have the same network. Mono's depth is right up to scale and shift. Metric's is that of a
camera whose focal length is 300 pixels of the network's image, from which metres follow.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from dyfn_core.models.base import AffineDepth, GeometryModel, Latent, Prepared, plane
from dyfn_core.models.depth_anything import (
    VARIANTS,
    Variant,
    budget_size,
    encoder_of,
    known_entries,
)
from dyfn_core.models.dinov2 import PATCH, DinoV2
from dyfn_core.models.dpt import DPTHead, resized
from dyfn_core.prediction import AFFINE_DEPTH, DEPTH

KINDS = ("mono", "metric")
PREFIXES = ("model.backbone.pretrained.", "model.da3.")  # of names in official files of this family
ENCODER_KEY = "model.backbone.pretrained.cls_token"  # in every official file
FOCAL = 300.0  # pixels of the network's image at which the metric model's depth is in metres
SKY = 0.3  # of the sky output, from where on a pixel is sky
FEWEST = 10  # pixels of sky, and of the rest, without which sky keeps its depth
SKY_QUANTILE = 0.99  # of the other pixels' depth, which sky is given


@dataclass(frozen=True)
class DepthAnything3Config:
    """kind: one of KINDS. encoder: a key of depth_anything.VARIANTS.

    process_size: what the image's longer side is resized to when no token budget is given.
    """

    kind: str
    encoder: str = "dinov2_vitl14"
    process_size: int = 504

    def __post_init__(self) -> None:
        for name, allowed in (("kind", KINDS), ("encoder", tuple(VARIANTS))):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} {getattr(self, name)!r} is unknown, expected {allowed}")
        if self.process_size < PATCH:
            raise ValueError(f"process_size must be at least {PATCH}, got {self.process_size}")


class Backbone(nn.Module):
    """The encoder under the name that it has in official files."""

    def __init__(self, encoder: str) -> None:
        super().__init__()
        self.pretrained = DinoV2(encoder, final_epsilon=1e-5, masks=False)


class Network(nn.Module):
    """Encoder and head under the names that they have in official files."""

    def __init__(self, encoder: str, variant: Variant) -> None:
        super().__init__()
        self.backbone = Backbone(encoder)
        channels = self.backbone.pretrained.channels
        self.head = DPTHead(channels, variant.widths, variant.channels, sky=True)


class DepthAnything3Model(GeometryModel):
    """Depth Anything 3 (mono or metric), with or without DyFN on its last fused map.

    Module names are those of the official files: "model.backbone.pretrained" and "model.head".
    """

    mask_threshold = 0.0  # of SKY less the sky output
    preparation = (
        "resize in 8 bits, by areas where it shrinks and bicubic where it grows; less the mean "
        "(.485, .456, .406), over (.229, .224, .225)"
    )
    stabilizer_pool = 4  # the latent is four times as fine as the tokens

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, config: DepthAnything3Config) -> None:
        super().__init__()
        self.settings = config
        self.quantity = AFFINE_DEPTH if config.kind == "mono" else DEPTH
        self.knows_metres = "" if config.kind == "mono" else "camera"
        self.variant = VARIANTS[config.encoder]
        self.model = Network(config.encoder, self.variant)
        mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
        # Not in official files, hence not in ours.
        self.register_buffer("image_mean", mean.view(1, 3, 1, 1), persistent=False)
        self.register_buffer("image_std", std.view(1, 3, 1, 1), persistent=False)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> DepthAnything3Model:
        """config: DepthAnything3Config's fields. ValueError for unknown or bad keys."""
        return cls(DepthAnything3Config(**known_entries(config, DepthAnything3Config, "3")))

    @property
    def config(self) -> dict[str, Any]:
        """DepthAnything3Config's fields and the type."""
        return {"type": "depth_anything_3", **asdict(self.settings)}

    @property
    def latent_channels(self) -> int:
        """Channels of the last fused map."""
        return self.variant.channels

    def network_sizes(
        self, image_size: tuple[int, int], num_tokens: int | None
    ) -> list[tuple[int, int]]:
        """The sizes (H, W) that an image takes one after the other; the last in multiples of 14.

        Without a budget the official rule: the longer side becomes process_size, then each side
        the nearest multiple of 14.
        """
        if num_tokens is not None:
            return [budget_size(image_size, num_tokens)]
        height, width = image_size
        factor = self.settings.process_size / max(height, width)
        first = (max(1, round(height * factor)), max(1, round(width * factor)))
        return [first, (_nearest_patches(first[0]), _nearest_patches(first[1]))]

    def prepare(self, image: Tensor, num_tokens: int | None = None) -> Prepared:
        """See GeometryModel: resized as officially, in 8 bits."""
        image_size = plane(image)
        sizes = self.network_sizes(image_size, num_tokens)
        resized = torch.from_numpy(np.stack([_resized(one, sizes) for one in _bytes(image)]))
        return self.normalised(resized.to(image.device), image_size)

    def normalised(self, image: Tensor, image_size: tuple[int, int]) -> Prepared:
        """The resized image, B x h x w x 3 uint8 -> what the encoder sees."""
        x = image.permute(0, 3, 1, 2).float() / 255
        return Prepared((x - self.image_mean) / self.image_std, image_size, plane(x))

    def encode_prepared(self, prepared: Prepared) -> Latent:
        """See GeometryModel: the last fused map, four cells a token along each side."""
        layers = self.model.backbone.pretrained(prepared.pixels, self.variant.blocks)
        return Latent(self.model.head.fuse(layers), prepared.image_size, prepared.network_size)

    def decode(self, latent: Latent) -> AffineDepth:
        """Latent -> depth and where there is no sky, at the image's size."""
        size = latent.network_size
        logit, sky = self.model.head.depth_and_sky(latent.features, size)
        depth = torch.stack(
            [_with_far_sky(z, s) for z, s in zip(logit.float().exp(), sky.float(), strict=True)]
        )
        depth, mask = resized(depth, latent.image_size), SKY - resized(sky, latent.image_size)
        return AffineDepth(depth[:, 0], mask[:, 0].float(), self.metres_of_focal(size))

    def metres_of_focal(self, network_size: tuple[int, int]) -> tuple[float, float] | None:
        """See GeometryModel."""
        height, width = network_size
        return (width / (2 * FOCAL), height / (2 * FOCAL)) if self.knows_metres else None


def _with_far_sky(depth: Tensor, sky: Tensor) -> Tensor:
    """One image's depth with sky far away: the official quantile, of this image and all pixels.

    The official code takes one for all images of a batch, and draws pixels of large ones.
    """
    is_sky = sky >= SKY
    rest = depth.numel() - is_sky.sum()
    ordered = torch.where(is_sky, torch.inf, depth).detach().flatten().sort().values
    place = SKY_QUANTILE * (rest - 1).clamp(min=0).double()
    lower = place.floor().long()
    upper = torch.minimum(lower + 1, (rest - 1).clamp(min=0))
    weight = (place - lower).to(depth.dtype)
    far = torch.lerp(ordered[lower], ordered[upper], weight)
    enough = (rest > FEWEST) & (depth.numel() - rest > FEWEST)  # no branch: an export has none
    return torch.where(is_sky & enough, far, depth)


def official_kind(names: Iterable[str]) -> str | None:
    """One of KINDS that the names of models or folders speak of; None for none, or for both."""
    found = {kind for name in names for kind in KINDS if f"da3{kind}" in name.lower()}
    return found.pop() if len(found) == 1 else None


def official_encoder(weights: dict[str, Tensor]) -> str:
    """Which DINOv2 an official state dict holds. Raises ValueError when it is none of VARIANTS."""
    return encoder_of(weights[ENCODER_KEY].shape[-1], "3")


def _bytes(image: Tensor) -> np.ndarray:
    """B x 3 x H x W in 0..1 -> B x H x W x 3 uint8."""
    levels = image.detach().mul(255).round().clamp(0, 255).byte()
    return np.ascontiguousarray(levels.permute(0, 2, 3, 1).cpu().numpy())


def _resized(image: np.ndarray, sizes: list[tuple[int, int]]) -> np.ndarray:
    for height, width in sizes:
        if image.shape[:2] != (height, width):
            grows = height > image.shape[0] or width > image.shape[1]
            how = cv2.INTER_CUBIC if grows else cv2.INTER_AREA
            image = cv2.resize(image, (width, height), interpolation=how)
    return image


def _nearest_patches(side: int) -> int:
    """The nearest multiple of the patch size, at least one; the larger of two as near."""
    return max(1, (2 * side + PATCH) // (2 * PATCH)) * PATCH
