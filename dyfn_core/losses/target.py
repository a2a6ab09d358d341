"""The true geometry that losses compare with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Target:
    """True points of a batch of frames.

    Attributes:
        points: B x H x W x 3 metres, optical frame; finite everywhere, meaningless where not valid.
        valid: B x H x W bool, the depth is known and finite.
        infinite: B x H x W bool, sky.
        focal: B, focal length in units of the image's diagonal.
    """

    points: Tensor
    valid: Tensor
    infinite: Tensor
    focal: Tensor

    def weight(self) -> Tensor:
        """1 / z on valid pixels, else 0: B x H x W (paper section 4)."""
        return torch.where(self.valid, 1 / self.points[..., 2], 0.0)


@dataclass(frozen=True)
class ClipTarget:
    """The true geometry of B clips of T frames.

    Attributes:
        frames: All frames of all clips, B * T in that order.
        length: T.
    """

    frames: Target
    length: int

    @property
    def valid(self) -> Tensor:
        """B x T x H x W bool."""
        return torch.unflatten(self.frames.valid, 0, (-1, self.length))

    @property
    def points(self) -> Tensor:
        """B x T x H x W x 3 metres."""
        return torch.unflatten(self.frames.points, 0, (-1, self.length))

    @property
    def weight(self) -> Tensor:
        """B x T x H x W: 1 / z where valid, else 0."""
        return torch.unflatten(self.frames.weight(), 0, (-1, self.length))


def target_from_depth(depth: Tensor, intrinsics: Tensor, aspect: float) -> Target:
    """Unproject true depth.

    Args:
        depth: B x H x W metres, inf for sky, NaN where unknown.
        intrinsics: B x 4, normalised fx, fy, cx, cy.
        aspect: Width / height of the image.

    Returns:
        The true points of the frames.
    """
    valid = torch.isfinite(depth) & (depth > 0)
    points = on_rays(torch.where(valid, depth, 1.0), intrinsics)
    diagonal = (aspect**2 + 1) ** 0.5
    focal = 0.5 * (intrinsics[:, 0] * aspect + intrinsics[:, 1]) / diagonal
    return Target(points, valid, torch.isposinf(depth), focal)


def on_rays(z: Tensor, intrinsics: Tensor) -> Tensor:
    """Points of a depth.

    Args:
        z: B x H x W.
        intrinsics: B x 4, normalised fx, fy, cx, cy.

    Returns:
        B x H x W x 3.
    """
    height, width = z.shape[-2:]
    u = (torch.arange(width, device=z.device) + 0.5) / width
    v = (torch.arange(height, device=z.device) + 0.5) / height
    fx, fy, cx, cy = (intrinsics[:, index, None, None] for index in range(4))
    x = (u[None, None, :] - cx) / fx * z
    y = (v[None, :, None] - cy) / fy * z
    return torch.stack([x, y, z], dim=-1)
