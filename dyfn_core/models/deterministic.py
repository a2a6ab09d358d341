"""Layers whose result has the same bits on any number of CPU threads, and alone or in a batch.

On the CPU torch picks another library for a convolution when it has one thread, or one small image,
and MKL splits the sums of small matrix products among its threads: the order of the sums changes.
Here every product is a convolution of oneDNN, whose threads share out the outputs and never one
sum; norms run on planes, and few channels are resized plane by plane. The values differ from those
of torch.nn in the last bits only. On other devices and dtypes, and in what is exported or compiled,
these are torch's own.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

FEW_CHANNELS = 4  # below, torch's resize adds up in another order on another number of threads


class DeterministicConv2d(nn.Conv2d):
    """nn.Conv2d without dilation and with padding in numbers; the same parameters."""

    def forward(self, x: Tensor) -> Tensor:
        """x: B x C x h x w -> B x C' x h' x w'."""
        if not _is_onednn(x, self.weight):
            return super().forward(x)
        padding = (int(self.padding[0]), int(self.padding[1]))
        if self.padding_mode != "zeros" and padding != (0, 0):
            x = F.pad(x, (padding[1], padding[1], padding[0], padding[0]), mode=self.padding_mode)
            padding = (0, 0)
        return convolve(x, self.weight, self.bias, self.stride[0], padding, self.groups)


class DeterministicGroupNorm(nn.GroupNorm):
    """nn.GroupNorm on planes: on channels_last torch sums per thread."""

    def forward(self, x: Tensor) -> Tensor:
        """x: B x C x h x w -> the same, contiguous."""
        return super().forward(x.contiguous())


class DeterministicLinear(nn.Linear):
    """nn.Linear on tokens or rows; the same parameters."""

    def forward(self, x: Tensor) -> Tensor:
        """x: B x n x C, or n x C -> the same with C' in place of C."""
        if not _is_onednn(x, self.weight):
            return super().forward(x)
        weight = self.weight[:, :, None, None]
        if x.dim() == 2:
            return convolve(x[:, :, None, None], weight, self.bias)[:, :, 0, 0]
        pixels = x.transpose(1, 2)[:, :, None]  # channels lie together: channels_last already
        return convolve(pixels, weight, self.bias)[:, :, 0].transpose(1, 2)


def convolve(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    stride: int = 1,
    padding: int | tuple[int, int] = 0,
    groups: int = 1,
) -> Tensor:
    """F.conv2d: x B x C x h x w, weight C' x C/groups x k x k -> B x C' x h' x w'."""
    if not _is_onednn(x, weight):
        return F.conv2d(x, weight, bias, stride, padding, groups=groups)
    pad = (padding, padding) if isinstance(padding, int) else padding
    is_pointwise = weight.shape[-2:] == (1, 1) and stride == groups == 1 and pad == (0, 0)
    if is_pointwise and x.shape[-2:] == (1, 1):  # oneDNN splits a sum when there are few outputs
        sums = (x[:, None, :, 0, 0] * weight[:, :, 0, 0]).sum(dim=-1)
        return (sums if bias is None else sums + bias)[..., None, None]
    # Planes of 1 x 1 oneDNN leaves to a matrix product that splits sums; pixels it does itself.
    source = _channels_last(x) if is_pointwise or x.stride(1) == 1 else x
    out: Tensor = torch.ops.aten.mkldnn_convolution(
        source, weight, bias, pad, (stride, stride), (1, 1), groups
    )
    return out.contiguous() if is_pointwise and x.is_contiguous() else out


def _channels_last(x: Tensor) -> Tensor:
    """x in channels_last, also by its strides, which views may have hidden in a batch of one."""
    x = x.contiguous(memory_format=torch.channels_last)
    if x.stride(0) * len(x) == x.numel():
        return x
    return x[0].permute(1, 2, 0)[None].permute(0, 3, 1, 2)


def resize(x: Tensor, size: tuple[int, ...], align_corners: bool = False) -> Tensor:
    """Bilinear: x B x C x h x w -> B x C x H x W; x itself when it has that size."""
    if tuple(x.shape[-2:]) == tuple(size):
        return x
    batch, channels, height, width = x.shape
    if channels < FEW_CHANNELS:
        x = x.reshape(batch * channels, 1, height, width)
    x = F.interpolate(x, tuple(size), mode="bilinear", align_corners=align_corners)
    return x.reshape(batch, channels, *size)


def is_traced() -> bool:
    """Whether this thread records what it computes, for an export."""
    return bool(torch.jit.is_tracing())  # type: ignore[attr-defined, no-untyped-call]


def _is_onednn(x: Tensor, weight: Tensor) -> bool:
    if is_traced() or torch.compiler.is_compiling():  # neither knows oneDNN's own call
        return False
    return (
        x.device.type == "cpu"
        and x.dtype == weight.dtype == torch.float32
        and torch.backends.mkldnn.is_available()
        and not torch.is_autocast_enabled("cpu")
    )
