"""MoGe v1: a DINOv2 encoder, a convolutional head, an affine-invariant point map."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dyfn_core.geometry.camera import uv_grid
from dyfn_core.models.base import (
    AffinePoints,
    GeometryModel,
    Latent,
    Prepared,
    own_entries,
    plane,
)
from dyfn_core.models.deterministic import DeterministicConv2d, DeterministicGroupNorm, resize
from dyfn_core.models.dinov2 import PATCH, SIZES, DinoV2

REMAPS = ("linear", "sinh", "exp", "sinh_exp")
NORMS = ("group_norm", "layer_norm")


@dataclass(frozen=True)
class MoGeConfig:
    """The architecture; field names and defaults are those of released MoGe v1 checkpoints.

    encoder: "dinov2_vits14", "dinov2_vitb14" or "dinov2_vitl14".
    intermediate_layers: how many last blocks feed the latent, or which blocks.
    num_tokens_range: how many tokens it was trained with; the upper end is the default.
    """

    encoder: str = "dinov2_vitb14"
    intermediate_layers: int | tuple[int, ...] = 4
    dim_proj: int = 512
    dim_upsample: tuple[int, ...] = (256, 128, 128)
    dim_times_res_block_hidden: int = 1
    num_res_blocks: int = 1
    remap_output: str = "linear"
    res_block_norm: str = "group_norm"
    num_tokens_range: tuple[int, int] = (1200, 2500)
    last_res_blocks: int = 0
    last_conv_channels: int = 32
    last_conv_size: int = 1
    mask_threshold: float = 0.5

    def __post_init__(self) -> None:
        for name, allowed in (
            ("encoder", tuple(SIZES)),
            ("remap_output", REMAPS),
            ("res_block_norm", NORMS),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} {getattr(self, name)!r} is unknown, expected {allowed}")

    @staticmethod
    def from_dict(values: dict[str, Any]) -> MoGeConfig:
        """From JSON-able values. Raises ValueError that names unknown keys."""
        known = {field.name for field in fields(MoGeConfig)}
        unknown = sorted(set(values) - known)
        if unknown:
            raise ValueError(f"unknown keys for a MoGe model: {unknown}, known are {sorted(known)}")
        frozen: dict[str, Any] = {
            key: tuple(value) if isinstance(value, list) else value for key, value in values.items()
        }
        return MoGeConfig(**frozen)


class ResidualBlock(nn.Module):
    """x + conv(relu(norm(conv(relu(norm(x)))))), 3 x 3, replicate padding."""

    def __init__(self, channels: int, hidden: int, norm: str) -> None:
        super().__init__()
        groups = hidden // 32 if norm == "group_norm" else 1
        self.layers = nn.Sequential(
            DeterministicGroupNorm(1, channels),
            nn.ReLU(),
            DeterministicConv2d(channels, hidden, 3, padding=1, padding_mode="replicate"),
            DeterministicGroupNorm(groups, hidden),
            nn.ReLU(),
            DeterministicConv2d(hidden, channels, 3, padding=1, padding_mode="replicate"),
        )

    def forward(self, x: Tensor) -> Tensor:
        """x: B x C x h x w."""
        result: Tensor = self.layers(x) + x
        return result


class Head(nn.Module):
    """Encoder layers -> latent (`fuse`); latent -> raw points and mask (`forward`)."""

    def __init__(self, config: MoGeConfig, num_features: int, encoder_channels: int) -> None:
        super().__init__()
        self.projects = nn.ModuleList(
            DeterministicConv2d(encoder_channels, config.dim_proj, 1) for _ in range(num_features)
        )
        widths = [config.dim_proj, *config.dim_upsample]
        self.upsample_blocks = nn.ModuleList(
            _upsample_block(before, after, config) for before, after in pairwise(widths)
        )
        self.output_block = nn.ModuleList(_output_block(count, config) for count in (3, 1))

    def fuse(self, layers: list[Tensor]) -> Tensor:
        """Encoder layers, each B x C x h x w -> the latent F, B x dim_proj x h x w."""
        projected: list[Tensor] = [
            project(layer) for project, layer in zip(self.projects, layers, strict=True)
        ]
        latent, *others = projected
        for other in others:
            latent = latent + other
        return latent

    def forward(self, latent: Tensor, network_size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """latent B x C x h x w -> raw points B x 3 x H x W, raw mask B x 1 x H x W."""
        aspect = network_size[1] / network_size[0]
        x = latent
        for block in self.upsample_blocks:
            x = block(_with_uv(x, aspect))
        x = resize(x, network_size)
        x = _with_uv(x, aspect)
        return self.output_block[0](x), self.output_block[1](x)


def _with_uv(x: Tensor, aspect: float) -> Tensor:
    uv = uv_grid(plane(x), aspect, x.dtype, x.device)
    return torch.cat([x, uv.expand(len(x), -1, -1, -1)], dim=1)


def _upsample_block(before: int, after: int, config: MoGeConfig) -> nn.Sequential:
    enlarge = nn.ConvTranspose2d(before + 2, after, 2, stride=2)
    with torch.no_grad():
        enlarge.weight.copy_(enlarge.weight[:, :, :1, :1].expand_as(enlarge.weight).clone())
    smooth = DeterministicConv2d(after, after, 3, padding=1, padding_mode="replicate")
    hidden = config.dim_times_res_block_hidden * after
    return nn.Sequential(
        nn.Sequential(enlarge, smooth),
        *(
            ResidualBlock(after, hidden, config.res_block_norm)
            for _ in range(config.num_res_blocks)
        ),
    )


def _output_block(count: int, config: MoGeConfig) -> nn.Sequential:
    width, size = config.last_conv_channels, config.last_conv_size
    hidden = config.dim_times_res_block_hidden * width
    return nn.Sequential(
        DeterministicConv2d(
            config.dim_upsample[-1] + 2, width, 3, padding=1, padding_mode="replicate"
        ),
        *(
            ResidualBlock(width, hidden, config.res_block_norm)
            for _ in range(config.last_res_blocks)
        ),
        nn.ReLU(),
        DeterministicConv2d(width, count, size, padding=size // 2, padding_mode="replicate"),
    )


def remap_points(raw: Tensor, remap: str) -> Tensor:
    """Raw head output ... x 3 -> affine-invariant points ... x 3 ("exp": z = e^z, xy = xy * z)."""
    if remap == "linear":
        return raw
    if remap == "sinh":
        return raw.sinh()
    xy, z = raw[..., :2], raw[..., 2:].exp()
    return torch.cat([xy * z if remap == "exp" else xy.sinh(), z], dim=-1)


class MoGeModel(GeometryModel):
    """MoGe v1, with or without DyFN on its latent (paper sections 2 and 3)."""

    preparation = (
        "resize to the network's size by bicubic interpolation with antialiasing; less the mean "
        "(.485, .456, .406), over (.229, .224, .225); resize to whole patches by bilinear "
        "interpolation with antialiasing"
    )

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, config: MoGeConfig) -> None:
        super().__init__()
        self.architecture = config
        self.mask_threshold = config.mask_threshold
        self.backbone = DinoV2(config.encoder)
        blocks = self.backbone.block_indices(config.intermediate_layers)
        self.head = Head(config, len(blocks), self.backbone.channels)
        self.register_buffer("image_mean", torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1))
        self.register_buffer("image_std", torch.tensor([0.229, 0.224, 0.225]).view(1, 3, 1, 1))

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> MoGeModel:
        """config: MoGeConfig's fields. ValueError for unknown or bad keys."""
        return cls(MoGeConfig.from_dict(own_entries(config)))

    @property
    def config(self) -> dict[str, Any]:
        """MoGeConfig's fields and the type."""
        return {"type": "moge", **asdict(self.architecture)}

    @property
    def latent_channels(self) -> int:
        """Channels of the summed projections."""
        return self.architecture.dim_proj

    def prepare(self, image: Tensor, num_tokens: int | None = None) -> Prepared:
        """See GeometryModel: resized to the token budget, normalised, resized to whole patches."""
        tokens = self.architecture.num_tokens_range[1] if num_tokens is None else num_tokens
        size = plane(image)
        network_size = resized(size, tokens)
        image = F.interpolate(
            image, network_size, mode="bicubic", align_corners=False, antialias=True
        )
        image = (image - self.image_mean) / self.image_std
        image = F.interpolate(
            image, whole_patches(network_size), mode="bilinear", align_corners=False, antialias=True
        )
        return Prepared(image, size, network_size)

    def encode_prepared(self, prepared: Prepared) -> Latent:
        """See GeometryModel: the summed projections of the last encoder layers."""
        layers = self.backbone(prepared.pixels, self.architecture.intermediate_layers)
        return Latent(self.head.fuse(layers), prepared.image_size, prepared.network_size)

    def stabilized_size(self, network_size: tuple[int, int]) -> tuple[int, int]:
        """As released: a stabilized frame is decoded at whole patches, the base is not."""
        return whole_patches(network_size)

    def decode(self, latent: Latent) -> AffinePoints:
        """Latent -> points and mask at the image's size."""
        points, mask = self.head(latent.features, latent.network_size)
        points = resize(points, latent.image_size)
        mask = resize(mask, latent.image_size)
        points = remap_points(points.movedim(1, -1).float(), self.architecture.remap_output)
        return AffinePoints(points, mask[:, 0].float())


def resized(size: tuple[int, int], num_tokens: int) -> tuple[int, int]:
    """(H, W) -> the size of about num_tokens patches and the same aspect, at least one patch.

    Raises ValueError when num_tokens is not positive.
    """
    if num_tokens < 1:
        raise ValueError(f"num_tokens must be at least 1, got {num_tokens}")
    height, width = size
    factor = math.sqrt(num_tokens * PATCH**2 / (height * width))
    return max(PATCH, int(height * factor)), max(PATCH, int(width * factor))


def whole_patches(size: tuple[int, int]) -> tuple[int, int]:
    """(H, W) rounded down to multiples of the patch size."""
    return size[0] // PATCH * PATCH, size[1] // PATCH * PATCH
