"""Depth Anything V2: a DINOv2 encoder and a DPT head, affine-invariant disparity.

The output is a / z + b with a > 0 and b unknown: disparity, not depth. Prediction says so.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from dyfn_core.models.base import (
    AffineDisparity,
    GeometryModel,
    Latent,
    Prepared,
    own_entries,
    plane,
)
from dyfn_core.models.dinov2 import PATCH, SIZES, DinoV2
from dyfn_core.models.dpt import DPTHead, resized


@dataclass(frozen=True)
class Variant:
    """blocks: the encoder layers used. widths: of the reassembled layers. channels: of the rest."""

    blocks: tuple[int, int, int, int]
    widths: tuple[int, int, int, int]
    channels: int


VARIANTS = {
    "dinov2_vits14": Variant((2, 5, 8, 11), (48, 96, 192, 384), 64),
    "dinov2_vitb14": Variant((2, 5, 8, 11), (96, 192, 384, 768), 128),
    "dinov2_vitl14": Variant((4, 11, 17, 23), (256, 512, 1024, 1024), 256),
}


@dataclass(frozen=True)
class DepthAnythingConfig:
    """encoder: a key of VARIANTS, which decides the rest of the architecture.

    input_size: what the image's shorter side is resized to when no token budget is given.
    """

    encoder: str = "dinov2_vits14"
    input_size: int = 518

    def __post_init__(self) -> None:
        if self.encoder not in VARIANTS:
            raise ValueError(
                f"encoder {self.encoder!r} is unknown, expected one of {sorted(VARIANTS)}"
            )
        if self.input_size < PATCH:
            raise ValueError(f"input_size must be at least {PATCH}, got {self.input_size}")


class DepthAnythingModel(GeometryModel):
    """Depth Anything V2 (relative), with or without DyFN on its last fused map.

    Module names are those of the official files: "pretrained" and "depth_head".
    """

    quantity = "disparity"
    stabilizer_pool = 4  # the latent is four times as fine as the tokens
    preparation = (
        "resize by bicubic interpolation; less the mean (.485, .456, .406), over (.229, .224, .225)"
    )

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, config: DepthAnythingConfig) -> None:
        super().__init__()
        self.settings = config
        self.variant = VARIANTS[config.encoder]
        self.pretrained = DinoV2(config.encoder)
        self.depth_head = DPTHead(
            self.pretrained.channels, self.variant.widths, self.variant.channels
        )
        mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
        # Not in official files, hence not in ours.
        self.register_buffer("image_mean", mean.view(1, 3, 1, 1), persistent=False)
        self.register_buffer("image_std", std.view(1, 3, 1, 1), persistent=False)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> DepthAnythingModel:
        """config: DepthAnythingConfig's fields. ValueError for unknown or bad keys."""
        return cls(DepthAnythingConfig(**known_entries(config, DepthAnythingConfig, "V2")))

    @property
    def config(self) -> dict[str, Any]:
        """DepthAnythingConfig's fields and the type."""
        return {"type": "depth_anything_v2", **asdict(self.settings)}

    @property
    def latent_channels(self) -> int:
        """Channels of the last fused map."""
        return self.variant.channels

    def network_size(self, image_size: tuple[int, int], num_tokens: int | None) -> tuple[int, int]:
        """(H, W) that the network works at, multiples of 14.

        Without a budget the official rule: the shorter side becomes input_size or little more.
        """
        height, width = image_size
        if num_tokens is None:
            least = self.settings.input_size
            factor = max(least / height, least / width)
            return _at_least(factor * height, least), _at_least(factor * width, least)
        return budget_size(image_size, num_tokens)

    def prepare(self, image: Tensor, num_tokens: int | None = None) -> Prepared:
        """See GeometryModel: resized to network_size."""
        image_size = plane(image)
        size = self.network_size(image_size, num_tokens)
        if size != image_size:
            image = F.interpolate(image, size, mode="bicubic", align_corners=False)
        return Prepared((image - self.image_mean) / self.image_std, image_size, size)

    def encode_prepared(self, prepared: Prepared) -> Latent:
        """See GeometryModel: the last fused map, four cells a token along each side."""
        layers = self.pretrained(prepared.pixels, self.variant.blocks)
        return Latent(self.depth_head.fuse(layers), prepared.image_size, prepared.network_size)

    def decode(self, latent: Latent) -> AffineDisparity:
        """Latent -> disparity at the image's size."""
        disparity = self.depth_head(latent.features, latent.network_size)
        return AffineDisparity(resized(disparity, latent.image_size)[:, 0].float())


def official_encoder(weights: dict[str, Tensor]) -> str:
    """Which DINOv2 an official state dict holds. Raises ValueError when it is none of VARIANTS."""
    token = weights.get("pretrained.cls_token")
    return encoder_of(None if token is None else token.shape[-1], "V2")


def encoder_of(channels: int | None, version: str) -> str:
    """Which of VARIANTS has so many channels. Raises ValueError that names the version."""
    for name in VARIANTS:
        if SIZES[name][0] == channels:
            return name
    raise ValueError(
        f"an encoder of {channels} channels is none of Depth Anything {version}'s that are "
        "supported: " + ", ".join(f"{name} ({SIZES[name][0]})" for name in VARIANTS)
    )


def known_entries(config: dict[str, Any], kind: type, version: str) -> dict[str, Any]:
    """A checkpoint's entries for a config class. Raises ValueError for others."""
    own, known = own_entries(config), {field.name for field in fields(kind)}
    if unknown := sorted(set(own) - known):
        raise ValueError(
            f"unknown keys for Depth Anything {version}: {unknown}, known are {sorted(known)}"
        )
    return own


def budget_size(image_size: tuple[int, int], num_tokens: int) -> tuple[int, int]:
    """(H, W) in multiples of 14 of about num_tokens tokens. Raises ValueError below one."""
    if num_tokens < 1:
        raise ValueError(f"num_tokens must be at least 1, got {num_tokens}")
    height, width = image_size
    factor = math.sqrt(num_tokens / (height * width))
    return max(1, round(height * factor)) * PATCH, max(1, round(width * factor)) * PATCH


def _at_least(side: float, least: int) -> int:
    """The nearest multiple of the patch size, the next larger one if that is below `least`."""
    nearest = round(side / PATCH) * PATCH
    return nearest if nearest >= least else math.ceil(side / PATCH) * PATCH
