"""Layers whose result has the same bits on any number of CPU threads, and alone or in a batch.

On the CPU torch picks another library for some of these operations when it has one thread or one
image, and MKL splits small products among its threads: the sums are then taken in another order.
Here every such product is oneDNN's convolution of 1 x 1, whose threads share out the outputs and
never one sum, and small channel counts are resized plane by plane. The values differ from those of
torch.nn in the last bits only. On other devices and dtypes these are torch's own.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FEW_CHANNELS = 4  # below, torch's resize adds up in another order on another number of threads


class Pointwise(nn.Conv2d):
    """nn.Conv2d of 1 x 1, stride 1, no padding; the same parameters."""

    def __init__(self, cin: int, cout: int) -> None:
        super().__init__(cin, cout, 1)

    def forward(self, x: Tensor) -> Tensor:
        """x: B x cin x h x w -> B x cout x h x w."""
        return pointwise(x, self.weight, self.bias)


class GroupNorm(nn.GroupNorm):
    """nn.GroupNorm on planes: on channels_last torch sums per thread."""

    def forward(self, x: Tensor) -> Tensor:
        """x: B x C x h x w -> the same, contiguous."""
        return super().forward(x.contiguous())


class Linear(nn.Linear):
    """nn.Linear on tokens; the same parameters."""

    def forward(self, x: Tensor) -> Tensor:
        """x: B x n x cin -> B x n x cout."""
        if not _is_onednn(x, self.weight):
            return F.linear(x, self.weight, self.bias)
        pixels = x.transpose(1, 2)[:, :, None]  # tokens are pixels whose channels lie together
        weight = self.weight[:, :, None, None]
        return pointwise(pixels, weight, self.bias)[:, :, 0].transpose(1, 2)


def pointwise(x: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
    """A convolution of 1 x 1: x B x cin x h x w, weight cout x cin x 1 x 1 -> B x cout x h x w."""
    if not _is_onednn(x, weight):
        return F.conv2d(x, weight, bias)
    if x.shape[-2:] == (1, 1):  # oneDNN splits the sum when there are few outputs
        sums = (x[:, None, :, 0, 0] * weight[:, :, 0, 0]).sum(dim=-1)
        return (sums if bias is None else sums + bias)[..., None, None]
    # oneDNN leaves planes to a matrix product that splits sums; pixels it does itself.
    pixels = x.contiguous(memory_format=torch.channels_last)
    out: Tensor = torch.ops.aten.mkldnn_convolution(pixels, weight, bias, (0, 0), (1, 1), (1, 1), 1)
    return out.contiguous() if x.is_contiguous() else out


def resize(x: Tensor, size: tuple[int, int], align_corners: bool = False) -> Tensor:
    """Bilinear: x B x C x h x w -> B x C x H x W; x itself when it has that size."""
    if tuple(x.shape[-2:]) == tuple(size):
        return x
    batch, channels, height, width = x.shape
    if channels < FEW_CHANNELS:
        x = x.reshape(batch * channels, 1, height, width)
    x = F.interpolate(x, size, mode="bilinear", align_corners=align_corners)
    return x.reshape(batch, channels, *size)


def _is_onednn(x: Tensor, weight: Tensor) -> bool:
    return (
        x.device.type == "cpu"
        and x.dtype == weight.dtype == torch.float32
        and torch.backends.mkldnn.is_available()
        and not torch.is_autocast_enabled("cpu")
    )
