"""The DPT heads of Depth Anything V2 and 3: four encoder layers in, one or two maps out.

Parameter names are those of the official files ("projects", "resize_layers", "scratch.*").
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from dyfn_core.models.deterministic import DeterministicConv2d, resize

OUTPUT_CHANNELS = 32


class ResidualConvUnit(nn.Module):
    """x + conv(relu(conv(relu(x)))), 3 x 3."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = DeterministicConv2d(channels, channels, 3, padding=1)
        self.conv2 = DeterministicConv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """x: B x C x h x w."""
        result: Tensor = self.conv2(F.relu(self.conv1(F.relu(x)))) + x
        return result


class FusionBlock(nn.Module):
    """A coarser path and a finer layer joined, refined and projected, at the finer resolution.

    beside: whether it has the unit for a finer layer.
    """

    def __init__(self, channels: int, beside: bool = True) -> None:
        super().__init__()
        if beside:
            self.resConfUnit1 = ResidualConvUnit(channels)
        self.resConfUnit2 = ResidualConvUnit(channels)
        self.out_conv = DeterministicConv2d(channels, channels, 1)

    def forward(self, path: Tensor, layer: Tensor | None) -> Tensor:
        """path, layer: B x C x h x w; the coarsest block has no layer beside it."""
        if layer is not None:
            path = path + self.resConfUnit1(layer)
        # A 1 x 1 convolution and the resizing that follows commute; this order is four times less.
        result: Tensor = self.out_conv(self.resConfUnit2(path))
        return result


class Scratch(nn.Module):
    """The part of the head after the reassembly, under the name that it has in official files.

    sky: as Depth Anything 3 has it, with a second output and without the unit that has no input.
    """

    def __init__(self, widths: tuple[int, ...], channels: int, sky: bool) -> None:
        super().__init__()
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = (
            DeterministicConv2d(width, channels, 3, padding=1, bias=False) for width in widths
        )
        self.refinenet1 = FusionBlock(channels)
        self.refinenet2 = FusionBlock(channels)
        self.refinenet3 = FusionBlock(channels)
        # The coarsest block's first unit is in every official file of V2 and has no input.
        self.refinenet4 = FusionBlock(channels, beside=not sky)
        self.output_conv1 = DeterministicConv2d(channels, channels // 2, 3, padding=1)
        self.output_conv2 = _output(channels // 2)
        if sky:
            self.sky_output_conv2 = _output(channels // 2)


def _output(channels: int) -> nn.Sequential:
    return nn.Sequential(
        DeterministicConv2d(channels, OUTPUT_CHANNELS, 3, padding=1),
        nn.ReLU(),
        DeterministicConv2d(OUTPUT_CHANNELS, 1, 1),
    )


class DPTHead(nn.Module):
    """Encoder layers -> latent (`fuse`); latent -> disparity (`forward`), or depth and sky.

    The latent is the last fusion block's output before its resizing, B x channels x 4h x 4w for an
    h x w grid of tokens: the one map that everything after it is computed from.
    """

    def __init__(
        self, encoder_channels: int, widths: tuple[int, ...], channels: int, sky: bool = False
    ) -> None:
        super().__init__()
        self.projects = nn.ModuleList(
            DeterministicConv2d(encoder_channels, width, 1) for width in widths
        )
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(widths[0], widths[0], 4, stride=4),
                nn.ConvTranspose2d(widths[1], widths[1], 2, stride=2),
                nn.Identity(),
                DeterministicConv2d(widths[3], widths[3], 3, stride=2, padding=1),
            ]
        )
        self.scratch = Scratch(widths, channels, sky)

    def fuse(self, layers: list[Tensor]) -> Tensor:
        """Four encoder layers, fine to coarse, each B x C x h x w -> the latent."""
        scratch = self.scratch
        narrow = (scratch.layer1_rn, scratch.layer2_rn, scratch.layer3_rn, scratch.layer4_rn)
        one, two, three, four = (
            reduce(resize(project(layer)))
            for project, resize, reduce, layer in zip(
                self.projects, self.resize_layers, narrow, layers, strict=True
            )
        )
        path = resized(scratch.refinenet4(four, None), three.shape[-2:])
        path = resized(scratch.refinenet3(path, three), two.shape[-2:])
        path = resized(scratch.refinenet2(path, two), one.shape[-2:])
        result: Tensor = scratch.refinenet1(path, one)
        return result

    def forward(self, latent: Tensor, size: tuple[int, int]) -> Tensor:
        """latent B x C x 4h x 4w -> disparity B x 1 x H x W >= 0 at the network's size."""
        return F.relu(self.scratch.output_conv2(self._shared(latent, size)))

    def depth_and_sky(self, latent: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """latent B x C x 4h x 4w -> log depth and sky (>= 0), B x 1 x H x W at the network's size.

        Of Depth Anything 3.
        """
        x = self._shared(latent, size)
        return self.scratch.output_conv2(x), F.relu(self.scratch.sky_output_conv2(x))

    def _shared(self, latent: Tensor, size: tuple[int, int]) -> Tensor:
        height, width = latent.shape[-2:]
        x: Tensor = self.scratch.output_conv1(resized(latent, (2 * height, 2 * width)))
        return resized(x, size)


def resized(x: Tensor, size: tuple[int, ...]) -> Tensor:
    """B x C x h x w -> B x C x size, bilinear between corners that stay corners."""
    return resize(x, size, align_corners=True)
