"""MoGe v2: a DINOv2 encoder, a neck and heads of five levels, metres from the class token."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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
from dyfn_core.models.deterministic import DeterministicConv2d, DeterministicLinear, resize
from dyfn_core.models.dinov2 import PATCH, SIZES, DinoV2
from dyfn_core.models.moge import REMAPS, remap_points

LEVELS = 5
UV = 2  # channels that say where a cell is
NORMS = ("none",)
ACTIVATIONS = ("relu",)
RESAMPLERS = ("conv_transpose", "bilinear")


@dataclass(frozen=True)
class EncoderConfig:
    """backbone: one of SIZES. intermediate_layers: which blocks, or how many last ones.

    dim_out: channels of the latent.
    """

    backbone: str
    intermediate_layers: int | tuple[int, ...]
    dim_out: int

    def __post_init__(self) -> None:
        _check("encoder.backbone", self.backbone, tuple(SIZES))


@dataclass(frozen=True)
class StackConfig:
    """One conv stack; the entries are those of released files, one value for each level.

    dim_in, dim_out: None is no convolution there. resamplers: one less than levels.
    """

    dim_in: tuple[int | None, ...]
    dim_out: tuple[int | None, ...]
    dim_res_blocks: tuple[int, ...]
    num_res_blocks: tuple[int, ...]
    resamplers: tuple[str, ...]
    res_block_in_norm: str
    res_block_hidden_norm: str
    activation: str = "relu"
    dim_times_res_block_hidden: int = 1

    def __post_init__(self) -> None:
        for name in ("dim_in", "dim_out", "dim_res_blocks", "num_res_blocks"):
            if len(getattr(self, name)) != LEVELS:
                raise ValueError(f"{name} has {len(getattr(self, name))} levels, expected {LEVELS}")
        if len(self.resamplers) != LEVELS - 1:
            raise ValueError(f"resamplers are {self.resamplers}, expected {LEVELS - 1} of them")
        for resampler in self.resamplers:
            _check("resamplers", resampler, RESAMPLERS)
        _check("res_block_in_norm", self.res_block_in_norm, NORMS)
        _check("res_block_hidden_norm", self.res_block_hidden_norm, NORMS)
        _check("activation", self.activation, ACTIVATIONS)

    @staticmethod
    def from_dict(name: str, values: Any) -> StackConfig:
        """From a file's entry `name`; what is missing takes the official default.

        Raises ValueError naming the entry.
        """
        known = [field.name for field in fields(StackConfig)]
        given = {"num_res_blocks": 1, "dim_out": None, **_entries(name, values, known)}
        given.setdefault("res_block_in_norm", "layer_norm")
        given.setdefault("res_block_hidden_norm", "group_norm")
        for key in ("dim_in", "dim_out", "num_res_blocks", "dim_res_blocks"):
            given[key] = _for_each(given.get(key), LEVELS)
        given["resamplers"] = _for_each(given.get("resamplers"), LEVELS - 1)
        try:
            return StackConfig(**given)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: {error}") from error


@dataclass(frozen=True)
class MoGe2Config:
    """The architecture; entries and defaults are those of released MoGe v2 checkpoints.

    num_tokens_range: how many tokens it was trained with; the upper end is the default.
    scale_head: widths of the layers that tell metres from the class token.
    """

    encoder: EncoderConfig
    neck: StackConfig
    points_head: StackConfig
    mask_head: StackConfig | None = None
    normal_head: StackConfig | None = None
    scale_head: tuple[int, ...] | None = None
    remap_output: str = "linear"
    num_tokens_range: tuple[int, int] = (1200, 3600)

    def __post_init__(self) -> None:
        _check("remap_output", self.remap_output, REMAPS)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> MoGe2Config:
        """From a file's model_config. Raises ValueError that names what is not supported."""
        known = [field.name for field in fields(MoGe2Config)]
        given = _entries("model_config", values, known)
        encoder = [field.name for field in fields(EncoderConfig)]
        described = _entries("encoder", given.get("encoder"), encoder)
        layers = described.get("intermediate_layers")
        if isinstance(layers, Sequence):
            described["intermediate_layers"] = tuple(layers)
        try:
            given["encoder"] = EncoderConfig(**described)
        except TypeError as error:
            raise ValueError(f"encoder: {error}") from error
        for name in ("neck", "points_head", "mask_head", "normal_head"):
            if given.get(name) is not None:
                given[name] = StackConfig.from_dict(name, given[name])
        if given.get("scale_head") is not None:
            given["scale_head"] = _scale_widths(given["scale_head"])
        if "num_tokens_range" in given:
            low, high = given["num_tokens_range"]
            given["num_tokens_range"] = (int(low), int(high))
        try:
            return MoGe2Config(**given)
        except TypeError as error:
            raise ValueError(f"model_config: {error}") from error

    def to_dict(self) -> dict[str, Any]:
        """JSON-able values that from_dict reads."""
        values = {key: value for key, value in asdict(self).items() if value is not None}
        if self.scale_head is not None:
            values["scale_head"] = {"dims": self.scale_head}
        return values


def _check(name: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise ValueError(f"{name} {value!r} is not supported, expected one of {allowed}")


def _entries(name: str, values: Any, known: Sequence[str]) -> dict[str, Any]:
    if not isinstance(values, Mapping):
        raise ValueError(f"{name} is {values!r}, expected entries of {sorted(known)}")
    if unknown := sorted(set(values) - set(known)):
        raise ValueError(f"{name}: unknown entries {unknown}, known are {sorted(known)}")
    return dict(values)


def _scale_widths(values: Any) -> tuple[int, ...]:
    widths = _entries("scale_head", values, ["dims"]).get("dims")
    if not isinstance(widths, Sequence) or len(widths) < 2:
        raise ValueError(f"scale_head: dims are {widths!r}, expected two widths or more")
    return tuple(widths)


def _for_each(value: Any, levels: int) -> tuple[Any, ...]:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return tuple(value)
    return (value,) * levels


class Encoder(nn.Module):
    """Image -> the latent, the sum of projected blocks, and the class token."""

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.layers = config.intermediate_layers
        self.backbone = DinoV2(config.backbone)
        count = len(self.backbone.block_indices(config.intermediate_layers))
        self.output_projections = nn.ModuleList(
            DeterministicConv2d(self.backbone.channels, config.dim_out, 1) for _ in range(count)
        )
        self.register_buffer("image_mean", torch.tensor([0.485, 0.456, 0.406]).view(1, 3, 1, 1))
        self.register_buffer("image_std", torch.tensor([0.229, 0.224, 0.225]).view(1, 3, 1, 1))

    def normalised(self, image: Tensor) -> Tensor:
        """image B x 3 x h x w in 0..1 -> less the mean, over the deviation."""
        return (image - self.image_mean) / self.image_std

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """image B x 3 x 14h x 14w, normalised -> latent B x D x h x w, class token B x C."""
        maps, summary = self.backbone.with_class_token(image, self.layers)
        projected: list[Tensor] = [
            project(one) for project, one in zip(self.output_projections, maps, strict=True)
        ]
        latent, *others = projected
        for other in others:
            latent = latent + other
        return latent, summary


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(relu(x)))), 3 x 3, replicate padding."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        # The official block has norms at 0 and 3, which released models leave out.
        self.layers = nn.Sequential(
            nn.Identity(),
            nn.ReLU(),
            _conv(channels, hidden),
            nn.Identity(),
            nn.ReLU(),
            _conv(hidden, channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        """x: B x C x h x w."""
        result: Tensor = self.layers(x) + x
        return result


class Upsample(nn.Module):
    """Twice as high and wide, bilinear."""

    def forward(self, x: Tensor) -> Tensor:
        """x: B x C x h x w."""
        return resize(x, (2 * x.shape[-2], 2 * x.shape[-1]))


class ConvStack(nn.Module):
    """Five levels from coarse to fine, each twice as large as the one before."""

    def __init__(self, config: StackConfig) -> None:
        super().__init__()
        widths = config.dim_res_blocks
        self.input_blocks = nn.ModuleList(
            _pointwise(before, width) for before, width in zip(config.dim_in, widths, strict=True)
        )
        self.resamplers = nn.ModuleList(
            _resampler(kind, *both)
            for kind, both in zip(config.resamplers, pairwise(widths), strict=True)
        )
        self.res_blocks = nn.ModuleList(
            nn.Sequential(
                *(
                    ResidualBlock(width, config.dim_times_res_block_hidden * width)
                    for _ in range(count)
                )
            )
            for width, count in zip(widths, config.num_res_blocks, strict=True)
        )
        self.output_blocks = nn.ModuleList(
            nn.Identity() if after is None else DeterministicConv2d(width, after, 1)
            for width, after in zip(widths, config.dim_out, strict=True)
        )

    def forward(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """One map a level, B x C_l x (2^l h) x (2^l w), in and out."""
        found: list[Tensor] = []
        x: Tensor | None = None
        for level, given in enumerate(inputs):
            here: Tensor = self.input_blocks[level](given)
            if x is not None:
                here = self.resamplers[level - 1](x) + here
            x = self.res_blocks[level](here)
            found.append(self.output_blocks[level](x))
        return found


def _pointwise(before: int | None, after: int) -> nn.Module:
    return nn.Identity() if before is None else DeterministicConv2d(before, after, 1)


def _conv(before: int, after: int) -> DeterministicConv2d:
    return DeterministicConv2d(before, after, 3, padding=1, padding_mode="replicate")


def _resampler(kind: str, before: int, after: int) -> nn.Sequential:
    if kind == "bilinear":
        return nn.Sequential(Upsample(), _conv(before, after))
    return nn.Sequential(nn.ConvTranspose2d(before, after, 2, stride=2), _conv(after, after))


class ScaleHead(nn.Sequential):
    """Class token -> logarithm of the metres in one unit."""

    def __init__(self, widths: Sequence[int]) -> None:
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [DeterministicLinear(before, after), nn.ReLU()]
        super().__init__(*layers[:-1])


class MoGe2Model(GeometryModel):
    """MoGe v2, with or without DyFN on the sum of its projected blocks.

    The latent is all that neck, points, mask and normals know of the image. The metres come from
    the class token, which bypasses DyFN (docs/models.md).
    """

    mask_threshold = 0.0  # of the raw mask: half of its sigmoid
    preparation = (
        "resize by bilinear interpolation with antialiasing; less the mean (.485, .456, .406), "
        "over (.229, .224, .225)"
    )
    normal_head: ConvStack | None
    mask_head: ConvStack | None
    scale_head: ScaleHead | None

    def __init__(self, config: MoGe2Config) -> None:
        super().__init__()
        self.architecture = config
        self.encoder = Encoder(config.encoder)
        self.neck = ConvStack(config.neck)
        self.points_head = ConvStack(config.points_head)
        self.normal_head = _head(config.normal_head)
        self.mask_head = _head(config.mask_head)
        self.scale_head = None if config.scale_head is None else ScaleHead(config.scale_head)
        self.has_normals = self.normal_head is not None
        self.knows_metres = "" if self.scale_head is None else "always"

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> MoGe2Model:
        """config: MoGe2Config's entries. ValueError for unknown or bad ones."""
        return cls(MoGe2Config.from_dict(own_entries(config)))

    @property
    def config(self) -> dict[str, Any]:
        """MoGe2Config's entries and the type."""
        return {"type": "moge2", **self.architecture.to_dict()}

    @property
    def latent_channels(self) -> int:
        """Channels of the summed projections."""
        return self.architecture.encoder.dim_out

    def prepare(self, image: Tensor, num_tokens: int | None = None) -> Prepared:
        """See GeometryModel: resized to the token budget."""
        size = plane(image)
        tokens = self.architecture.num_tokens_range[1] if num_tokens is None else num_tokens
        rows, columns = token_grid(size, tokens)
        network_size = (PATCH * rows, PATCH * columns)
        image = F.interpolate(
            image, network_size, mode="bilinear", align_corners=False, antialias=True
        )
        return Prepared(self.encoder.normalised(image), size, network_size)

    def encode_prepared(self, prepared: Prepared) -> Latent:
        """See GeometryModel: the summed projections of the chosen blocks."""
        features, summary = self.encoder(prepared.pixels)
        return Latent(features, prepared.image_size, prepared.network_size, summary)

    def decode(self, latent: Latent) -> AffinePoints:
        """Latent -> points, mask and metric scale at the image's size; no normals."""
        return self._decode(latent, None)

    def decode_all(self, latent: Latent) -> AffinePoints:
        """As decode, and the normals if the model has them."""
        return self._decode(latent, self.normal_head)

    def _decode(self, latent: Latent, normal_head: ConvStack | None) -> AffinePoints:
        size = latent.image_size
        maps = self.levels(latent)
        raw = resize(self.points_head(maps)[-1], size)
        points = remap_points(raw.movedim(1, -1).float(), self.architecture.remap_output)
        if self.mask_head is None:
            mask = torch.ones_like(points[..., 2])
        else:
            mask = resize(self.mask_head(maps)[-1], size)[:, 0].float()
        scale, normal = None, None
        if self.scale_head is not None and latent.summary is not None:
            scale = self.scale_head(latent.summary)[:, 0].float().exp()
        if normal_head is not None:
            normal = F.normalize(resize(normal_head(maps)[-1], size).movedim(1, -1).float(), dim=-1)
        return AffinePoints(points, mask, scale, normal)

    def levels(self, latent: Latent) -> list[Tensor]:
        """The neck's five maps."""
        height, width = latent.image_size
        features = latent.features
        rows, columns = plane(features)
        sizes = [(rows << level, columns << level) for level in range(LEVELS)]
        places = [
            uv_grid(size, width / height, features.dtype, features.device).expand(
                len(features), -1, -1, -1
            )
            for size in sizes
        ]
        maps: list[Tensor] = self.neck([torch.cat([features, places[0]], dim=1), *places[1:]])
        return maps


def _head(config: StackConfig | None) -> ConvStack | None:
    return None if config is None else ConvStack(config)


def token_grid(size: tuple[int, int], num_tokens: int) -> tuple[int, int]:
    """(H, W) of an image -> rows and columns of about num_tokens tokens, at least one each.

    Raises ValueError when num_tokens is not positive.
    """
    if num_tokens < 1:
        raise ValueError(f"num_tokens must be at least 1, got {num_tokens}")
    aspect = size[1] / size[0]
    rows, columns = round(math.sqrt(num_tokens / aspect)), round(math.sqrt(num_tokens * aspect))
    return max(1, rows), max(1, columns)
