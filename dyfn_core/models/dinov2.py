"""The DINOv2 vision transformer, as a feature extractor (parameter names as released)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dyfn_core.models.deterministic import DeterministicConv2d, DeterministicLinear

PATCH = 14
TRAINED_GRID = 37
# Released weights are resized with this offset on the token count; it must stay.
_OFFSET = 0.1

# name -> (channels, blocks, heads)
SIZES = {
    "dinov2_vits14": (384, 12, 6),
    "dinov2_vitb14": (768, 12, 12),
    "dinov2_vitl14": (1024, 24, 16),
}


class PatchEmbedding(nn.Module):
    """B x 3 x H x W -> B x N x C, one token per 14 x 14 patch."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.proj = DeterministicConv2d(3, channels, PATCH, stride=PATCH)

    def forward(self, image: Tensor) -> Tensor:
        """image: H and W multiples of 14."""
        result: Tensor = self.proj(image).flatten(2).transpose(1, 2)
        return result


class Attention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = DeterministicLinear(channels, 3 * channels)
        self.proj = DeterministicLinear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """x: B x N x C."""
        qkv = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        query, key, value = qkv.unbind(0)
        attended = F.scaled_dot_product_attention(query, key, value)
        result: Tensor = self.proj(attended.transpose(1, 2).flatten(2))
        return result


class FeedForward(nn.Module):
    """Two layers with a GELU, four times as wide inside."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.fc1 = DeterministicLinear(channels, 4 * channels)
        self.fc2 = DeterministicLinear(4 * channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """x: B x N x C."""
        result: Tensor = self.fc2(F.gelu(self.fc1(x)))
        return result


class LayerScale(nn.Module):
    """A learned factor per channel on a residual branch."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """x: B x N x C."""
        return x * self.gamma


class TransformerBlock(nn.Module):
    """Pre-norm transformer block with layer scale."""

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(channels, eps=1e-6)
        self.attn = Attention(channels, heads)
        self.ls1 = LayerScale(channels)
        self.norm2 = nn.LayerNorm(channels, eps=1e-6)
        self.mlp = FeedForward(channels)
        self.ls2 = LayerScale(channels)

    def forward(self, x: Tensor) -> Tensor:
        """x: B x N x C."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        result: Tensor = x + self.ls2(self.mlp(self.norm2(x)))
        return result


class DinoV2(nn.Module):
    """DINOv2 ViT-S/B/L with patch 14.

    final_epsilon: of the norm after the last block. masks: whether the file has a mask_token, which
    masked patches in pre-training and is unused here.
    """

    def __init__(self, name: str, final_epsilon: float = 1e-6, masks: bool = True) -> None:
        """name: one of SIZES. Raises ValueError for another."""
        super().__init__()
        if name not in SIZES:
            raise ValueError(f"encoder {name!r} is unknown, expected one of {sorted(SIZES)}")
        self.channels, depth, heads = SIZES[name]
        self.patch_embed = PatchEmbedding(self.channels)
        self.cls_token = nn.Parameter(torch.zeros(1, 1, self.channels))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + TRAINED_GRID**2, self.channels))
        if masks:
            self.mask_token = nn.Parameter(torch.zeros(1, self.channels))
        self.blocks = nn.ModuleList(TransformerBlock(self.channels, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(self.channels, eps=final_epsilon)

    def forward(self, image: Tensor, layers: int | Sequence[int]) -> list[Tensor]:
        """image: B x 3 x H x W, normalised, H and W multiples of 14.

        layers: how many last blocks, or which blocks. Returns per block the patch tokens after
        the final norm, B x C x H/14 x W/14.
        """
        return self.with_class_token(image, layers)[0]

    def with_class_token(
        self, image: Tensor, layers: int | Sequence[int]
    ) -> tuple[list[Tensor], Tensor]:
        """As forward, and the class token of the last of these blocks after the norm, B x C."""
        grid = (int(image.shape[-2]) // PATCH, int(image.shape[-1]) // PATCH)
        tokens = self.patch_embed(image)
        x = torch.cat([self.cls_token.expand(len(tokens), -1, -1), tokens], dim=1)
        x = x + self._position_embedding(grid)
        wanted = self.block_indices(layers)
        kept: dict[int, Tensor] = {}
        for index in range(max(wanted) + 1):
            x = self.blocks[index](x)
            if index in wanted:
                kept[index] = self.norm(x)
        maps = [kept[index][:, 1:].transpose(1, 2).unflatten(2, grid) for index in wanted]
        return maps, kept[wanted[-1]][:, 0]

    def block_indices(self, layers: int | Sequence[int]) -> list[int]:
        """The blocks that `layers` means. Raises ValueError for blocks that do not exist."""
        depth = len(self.blocks)
        wanted = list(range(depth - layers, depth)) if isinstance(layers, int) else list(layers)
        if not wanted or min(wanted) < 0 or max(wanted) >= depth:
            raise ValueError(
                f"intermediate layers {layers} do not fit an encoder of {depth} blocks"
            )
        return wanted

    def _position_embedding(self, grid: tuple[int, int]) -> Tensor:
        if grid == (TRAINED_GRID, TRAINED_GRID):
            return self.pos_embed
        patches = self.pos_embed[:, 1:].unflatten(1, (TRAINED_GRID, TRAINED_GRID))
        factors = tuple((count + _OFFSET) / TRAINED_GRID for count in grid)
        patches = F.interpolate(patches.permute(0, 3, 1, 2), scale_factor=factors, mode="bicubic")
        return torch.cat([self.pos_embed[:, :1], patches.flatten(2).transpose(1, 2)], dim=1)
