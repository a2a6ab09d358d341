"""The true geometry that losses compare with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Target:
    """True points of a batch of frames.

    points: B x H x W x 3 metres, optical frame; finite everywhere, meaningless where not valid.
    valid: B x H x W bool, the depth is finite. infinite: B x H x W bool, sky.
    focal: B, focal length in units of the image's diagonal.
    """

    points: Tensor
    valid: Tensor
    infinite: Tensor
    focal: Tensor

    def weight(self) -> Tensor:
        """1 / z on valid pixels, else 0: B x H x W (paper section 4)."""
        return torch.where(self.valid, 1 / self.points[..., 2], 0.0)


def target_from_depth(depth: Tensor, intrinsics: Tensor, aspect: float) -> Target:
    """depth B x H x W metres (inf sky, NaN invalid), normalised fx, fy, cx, cy B x 4 -> Target.

    aspect: width / height of the image.
    """
    valid = torch.isfinite(depth) & (depth > 0)
    z = torch.where(valid, depth, 1.0)
    height, width = depth.shape[-2:]
    u = (torch.arange(width, device=depth.device) + 0.5) / width
    v = (torch.arange(height, device=depth.device) + 0.5) / height
    fx, fy, cx, cy = (intrinsics[:, index, None, None] for index in range(4))
    x = (u[None, None, :] - cx) / fx * z
    y = (v[None, :, None] - cy) / fy * z
    diagonal = (aspect**2 + 1) ** 0.5
    focal = 0.5 * (intrinsics[:, 0] * aspect + intrinsics[:, 1]) / diagonal
    return Target(torch.stack([x, y, z], dim=-1), valid, torch.isposinf(depth), focal)
