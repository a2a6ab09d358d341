"""`mini`: the small geometry model for a robot's CPU, MoGe's design around EfficientNet-Lite0.

Encoder features at strides 8, 16 and 32 are projected and summed at stride 8: the latent F, the
only thing that the decoder sees. The decoder is MoGe's in small: normalised view-plane
coordinates before each stage, upsampling, residual blocks, separate outputs for points and mask.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dyfn_core.models.base import (
    AffinePoints,
    GeometryModel,
    Latent,
    Prepared,
    own_entries,
    plane,
)
from dyfn_core.models.deterministic import (
    DeterministicConv2d,
    DeterministicGroupNorm,
    DeterministicLinear,
    resize,
)
from dyfn_core.models.efficientnet import (
    FEATURE_CHANNELS,
    IMAGE_MEAN,
    IMAGE_STD,
    EfficientNetLite0,
    imagenet_weights,
)

CELL = 16  # pixels along the side of one token of the budget
MULTIPLE = 32  # network sizes are multiples of the encoder's largest stride
LATENT_STRIDE = 8
FEATURE_SPREAD = (7.0, 6.0, 2.5)  # standard deviations of the ImageNet encoder's features
VIEW_SLOPE = 0.8  # x / z at the edge of a view plane of unit half diagonal, before training
RAW_LIMIT = 8.0
SLOPE = 0.1  # of the activations below zero: none can die


@dataclass(frozen=True)
class MiniConfig:
    """What decides the shape of a MiniModel.

    latent_channels: C of the latent. stage_channels: the decoder's channels at strides 8, 4, ...,
    one stage each; the outputs come from the last, at twice its resolution. context_channels,
    context_layers, context_heads: the transformer on the stride-32 map. refine: a residual block
    after each sum of the neck, so that finer features decide where coarse depth ends. num_tokens:
    default budget, in cells of 16 x 16 pixels (192 = 256 x 192). folded: the encoder's
    normalisation is part of its weights.
    """

    latent_channels: int = 96
    stage_channels: tuple[int, ...] = (96, 48)
    context_channels: int = 192
    context_layers: int = 2
    context_heads: int = 6
    refine: bool = True
    num_tokens: int = 192
    folded: bool = True


class MiniResidualBlock(nn.Module):
    """x + conv(act(norm(conv(act(norm(x)))))), every channel normalised by itself.

    The latent's channels sit at very different levels, and that is where it keeps the scale. Norms
    over groups of channels let the largest decide, the others reach the activation as constants,
    and no gradient ever tells an edge from a wall.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = DeterministicGroupNorm(channels, channels)
        self.first = DeterministicConv2d(channels, channels, 3, padding=1, bias=False)
        self.norm_second = DeterministicGroupNorm(channels, channels)
        self.second = DeterministicConv2d(channels, channels, 3, padding=1)
        nn.init.normal_(self.second.weight, std=1e-2)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        inner = self.first(F.leaky_relu(self.norm(x), SLOPE))
        result: Tensor = x + self.second(F.leaky_relu(self.norm_second(inner), SLOPE))
        return result


class ContextLayer(nn.Module):
    """Pre-norm transformer layer with a depthwise convolution as positional encoding."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.position = DeterministicConv2d(channels, channels, 3, padding=1, groups=channels)
        self.norm_attention = nn.LayerNorm(channels)
        self.qkv = DeterministicLinear(channels, 3 * channels)
        self.out = DeterministicLinear(channels, channels)
        self.norm_mlp = nn.LayerNorm(channels)
        self.mlp = nn.Sequential(
            DeterministicLinear(channels, 2 * channels),
            nn.GELU(),
            DeterministicLinear(2 * channels, channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        batch, channels, height, width = x.shape
        x = x + self.position(x)
        tokens = x.flatten(2).transpose(1, 2)
        qkv = self.qkv(self.norm_attention(tokens))
        q, k, v = qkv.view(batch, -1, 3, self.heads, channels // self.heads).permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v)
        tokens = tokens + self.out(mixed.transpose(1, 2).reshape(batch, -1, channels))
        tokens = tokens + self.mlp(self.norm_mlp(tokens))
        result: Tensor = tokens.transpose(1, 2).reshape(batch, channels, height, width)
        return result


class Neck(nn.Module):
    """Encoder features -> latent: context on the deepest map, projections, sum at stride 8."""

    def __init__(self, config: MiniConfig) -> None:
        super().__init__()
        fine, middle, deep = FEATURE_CHANNELS
        self.context_in = DeterministicConv2d(deep, config.context_channels, 1)
        self.context = nn.Sequential(
            *(
                ContextLayer(config.context_channels, config.context_heads)
                for _ in range(config.context_layers)
            )
        )
        channels = config.latent_channels
        self.project_fine = DeterministicConv2d(fine, channels, 1)
        self.project_middle = DeterministicConv2d(middle, channels, 1)
        self.project_deep = DeterministicConv2d(config.context_channels, channels, 1)
        self.refine_middle = MiniResidualBlock(channels) if config.refine else nn.Identity()
        self.refine_fine = MiniResidualBlock(channels) if config.refine else nn.Identity()

    def forward(self, features: list[Tensor]) -> Tensor:
        fine, middle, deep = (
            feature / spread for feature, spread in zip(features, FEATURE_SPREAD, strict=True)
        )
        size = fine.shape[-2:]
        deep = self.project_deep(self.context(self.context_in(deep)))
        coarse = self.project_middle(middle) + resize(deep, middle.shape[-2:])
        coarse = self.refine_middle(coarse)
        latent: Tensor = self.refine_fine(self.project_fine(fine) + resize(coarse, size))
        return latent


class Decoder(nn.Module):
    """Latent -> raw points (3) and mask (1) at twice the resolution of the last stage."""

    def __init__(self, config: MiniConfig) -> None:
        super().__init__()
        joins, stages = [], []
        channels = config.latent_channels
        for width in config.stage_channels:
            joins.append(DeterministicConv2d(channels + 2, width, 1))
            stages.append(MiniResidualBlock(width))
            channels = width
        self.joins, self.stages = nn.ModuleList(joins), nn.ModuleList(stages)
        out = DeterministicConv2d(32, 3 * 4, 1)
        nn.init.normal_(out.weight, std=1e-2)
        nn.init.zeros_(out.bias)  # type: ignore[arg-type]
        self.points = nn.Sequential(
            DeterministicConv2d(channels + 2, 32, 3, padding=1),
            nn.LeakyReLU(SLOPE),
            out,
            nn.PixelShuffle(2),
        )
        self.mask = nn.Sequential(
            DeterministicConv2d(channels + 2, 16, 3, padding=1),
            nn.LeakyReLU(SLOPE),
            DeterministicConv2d(16, 4, 1),
            nn.PixelShuffle(2),
        )

    def forward(self, latent: Tensor, aspect: float) -> tuple[Tensor, Tensor]:
        x = latent
        for index, (join, stage) in enumerate(zip(self.joins, self.stages, strict=True)):
            x = join(_with_view_plane(x, aspect))
            if index > 0:
                x = resize(x, (x.shape[-2] * 2, x.shape[-1] * 2))
            x = stage(x)
        x = _with_view_plane(x, aspect)
        points = self.points(x)
        # Untrained, the points are a plane facing a pinhole camera: from anything less regular
        # the best scale is near zero, and so is the gradient.
        rays = VIEW_SLOPE * _view_plane(points, aspect)
        return torch.cat([points[:, :2] + rays, points[:, 2:]], dim=1), self.mask(x)


class MiniModel(GeometryModel):
    """The small model; `config` rebuilds it, `stabilizer` is DyFN or None."""

    mask_threshold = 0.5
    token_cell = CELL
    preparation = (
        "resize by bilinear interpolation with antialiasing; (x - 127 / 255) / (128 / 255)"
    )

    def __init__(self, config: MiniConfig | None = None) -> None:
        super().__init__()
        self.settings = config or MiniConfig()
        self.encoder = EfficientNetLite0(folded=self.settings.folded)
        self.neck = Neck(self.settings)
        self.decoder = Decoder(self.settings)
        self.stabilizer = None

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> MiniModel:
        """The model of a checkpoint's config; `type` and `stabilizer` are not for this class."""
        fields = own_entries(config)
        if "stage_channels" in fields:
            fields["stage_channels"] = tuple(fields["stage_channels"])
        return cls(MiniConfig(**fields))

    @property
    def config(self) -> dict[str, Any]:
        """Plain values that from_config rebuilds this model from."""
        fields = asdict(self.settings)
        return {"type": "mini", **fields, "stage_channels": list(fields["stage_channels"])}

    @property
    def latent_channels(self) -> int:
        return self.settings.latent_channels

    def load_imagenet_encoder(self) -> None:
        """Start the encoder from the ImageNet weights (FileNotFoundError when not installed)."""
        self.encoder.load_imagenet(imagenet_weights())

    def folded(self) -> MiniModel:
        """A copy whose encoder carries its fixed normalisation in its weights."""
        copy = MiniModel(MiniConfig(**{**asdict(self.settings), "folded": False}))
        if self.settings.folded:
            copy.encoder.fold()
        copy.stabilizer = self.stabilizer
        copy.load_state_dict(self.state_dict(), strict=True)
        copy.encoder.fold()
        copy.settings = MiniConfig(**{**asdict(self.settings), "folded": True})
        return copy.train(self.training)

    def network_size(self, image_size: tuple[int, int], num_tokens: int | None) -> tuple[int, int]:
        """(H, W) that the network works at: the budget at the image's aspect, multiples of 32."""
        height, width = image_size
        budget = num_tokens or self.settings.num_tokens
        factor = math.sqrt(budget * CELL * CELL / (height * width))
        return (
            max(1, round(height * factor / MULTIPLE)) * MULTIPLE,
            max(1, round(width * factor / MULTIPLE)) * MULTIPLE,
        )

    def prepare(self, image: Tensor, num_tokens: int | None = None) -> Prepared:
        """See GeometryModel: resized to network_size."""
        return self.prepare_at(image, self.network_size(plane(image), num_tokens))

    def prepare_at(self, image: Tensor, size: tuple[int, int]) -> Prepared:
        """As prepare, at a network size that the caller chose (multiples of 32)."""
        image_size = plane(image)
        if image_size != size:
            image = F.interpolate(image, size, mode="bilinear", antialias=True)
        return Prepared((image - IMAGE_MEAN) / IMAGE_STD, image_size, size)

    def encode_prepared(self, prepared: Prepared) -> Latent:
        """See GeometryModel; the features are B x C x h/8 x w/8."""
        pixels = prepared.pixels.contiguous(memory_format=torch.channels_last)
        features = self.neck(self.encoder(pixels))
        return Latent(features, prepared.image_size, prepared.network_size)

    def encode_at(self, image: Tensor, size: tuple[int, int]) -> Latent:
        """As encode, at a network size that the caller chose (multiples of 32)."""
        return self.encode_prepared(self.prepare_at(image, size))

    def decode_raw(self, latent: Latent) -> tuple[Tensor, Tensor]:
        """Raw points B x 3 x h x w and mask B x h x w at the decoder's own resolution."""
        height, width = latent.image_size
        points, mask = self.decoder(latent.features, width / height)
        return points, mask[:, 0]

    def decode(self, latent: Latent) -> AffinePoints:
        """Latent -> affine-invariant points at latent.image_size."""
        points, mask = self.decode_raw(latent)
        points = resize(points, latent.image_size)
        mask = resize(mask[:, None], latent.image_size)[:, 0]
        return AffinePoints(remap_exp(points.float()), mask.float())


def remap_exp(raw: Tensor) -> Tensor:
    """Raw points B x 3 x h x w -> B x h x w x 3: z = exp(z_raw), xy = xy_raw z.

    z_raw is bounded so that no step of training can reach an infinite z.
    """
    z = raw[:, 2:].clamp(-RAW_LIMIT, RAW_LIMIT).exp()
    return torch.cat([raw[:, :2] * z, z], dim=1).permute(0, 2, 3, 1)


def _view_plane(like: Tensor, aspect: float) -> Tensor:
    """B x 2 x h x w: position on the view plane, whose diagonal spans -1 to 1."""
    batch, (height, width) = like.shape[0], plane(like)
    span_x = aspect / math.hypot(aspect, 1)
    span_y = 1 / math.hypot(aspect, 1)
    u = torch.linspace(-1 + 1 / width, 1 - 1 / width, width, dtype=like.dtype, device=like.device)
    v = torch.linspace(
        -1 + 1 / height, 1 - 1 / height, height, dtype=like.dtype, device=like.device
    )
    grid = torch.stack(torch.meshgrid(u * span_x, v * span_y, indexing="xy"))
    return grid.expand(batch, -1, -1, -1)


def _with_view_plane(x: Tensor, aspect: float) -> Tensor:
    return torch.cat([x, _view_plane(x, aspect)], dim=1)
