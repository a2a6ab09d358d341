"""A small geometry model that is right by construction, and pictures for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from dyfn_core.geometry.camera import depth_to_points, focal_from_fov, intrinsics_from_focal
from dyfn_core.models.base import AffinePoints, GeometryModel, Latent, Prepared
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from tests.support.seeded import redraw

FOV_X = 70.0


class PinholeModel(GeometryModel):
    """Reads depth (red + 0.5), z-shift (mean of green) and mask (blue < 0.9) off the image.

    Its points are those of a centred pinhole camera of FOV_X, moved along z by minus the shift.
    """

    def __init__(self, stabilized: bool = False) -> None:
        super().__init__()
        self.unit = torch.nn.Parameter(torch.ones(1))
        if stabilized:
            torch.manual_seed(0)
            self.stabilizer = build_dyfn(3, DyFNConfig(hidden=4, form="residual"))
            heads = self.stabilizer.gamma_head, self.stabilizer.beta_head
            redraw((head.weight for head in heads), 0.05, seed=0)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> PinholeModel:
        return cls()

    @property
    def config(self) -> dict[str, Any]:
        return {"type": "pinhole"}

    @property
    def latent_channels(self) -> int:
        return 3

    def encode_prepared(self, prepared: Prepared) -> Latent:
        features = prepared.pixels * self.unit
        return Latent(features, prepared.image_size, prepared.network_size)

    def decode(self, latent: Latent) -> AffinePoints:
        height, width = latent.image_size
        depth = latent.features[:, 0] + 0.5
        shift = latent.features[:, 1].mean(dim=(-2, -1))
        focal = focal_from_fov(FOV_X, width / height, len(depth)).float()
        points = depth_to_points(depth, intrinsics_from_focal(focal, width / height))
        points = points - torch.stack([0 * shift, 0 * shift, shift], -1)[:, None, None]
        return AffinePoints(points, 1.4 - latent.features[:, 2])


def picture(seed: int = 0, shift: float = 0.0, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """H x W x 3 uint8 for PinholeModel: smooth depth, one shift, no masked pixel."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: size[0], : size[1]] / 10.0
    phase = rng.uniform(0, 6, 2)
    red = 0.5 + 0.2 * np.sin(x + phase[0]) + 0.2 * np.cos(y + phase[1])
    image = np.stack([red, np.full(size, shift), np.zeros(size)], axis=-1)
    return np.round(image * 255).astype(np.uint8)
