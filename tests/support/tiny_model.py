"""A geometry model that is small, seeded and real: convolutions around one latent, and DyFN.

Two pictures make it behave badly on demand: see FAILING and BLOCKING.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from dyfn_core.models.base import AffinePoints, GeometryModel, Latent, Prepared
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn

FAILING = (1, 2, 3)  # a first pixel of this colour makes inference raise
BLOCKING = (9, 8, 7)  # this one makes it say so in the pipe $TINY_ENTERED and wait for $TINY_GO
CHANNELS = 6


class TinyModel(GeometryModel):
    has_normals = True

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.Conv2d(3, CHANNELS, 5, stride=4, padding=2)
        self.head = nn.Conv2d(CHANNELS, 2, 3, padding=1)

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> GeometryModel:
        return cls()

    @property
    def config(self) -> dict[str, Any]:
        return {"type": "tiny"}

    @property
    def latent_channels(self) -> int:
        return CHANNELS

    def encode_prepared(self, prepared: Prepared) -> Latent:
        image = prepared.pixels
        first = {tuple(one) for one in (image[:, :, 0, 0] * 255).round().int().tolist()}
        if FAILING in first:
            raise RuntimeError("the picture that must fail")
        if BLOCKING in first:
            wait_for_go()
        return Latent(self.encoder(image), prepared.image_size, prepared.network_size)

    def decode(self, latent: Latent) -> AffinePoints:
        height, width = latent.image_size
        raw = functional.interpolate(self.head(latent.features), latent.image_size, mode="bilinear")
        z = torch.exp(raw[:, 0])
        v, u = torch.meshgrid(
            (torch.arange(height) + 0.5 - height / 2) / width,
            (torch.arange(width) + 0.5) / width - 0.5,
            indexing="ij",
        )
        points = torch.stack([u * z, v * z, z], dim=-1)
        return AffinePoints(points, raw[:, 1] - raw[:, 1].mean((1, 2), keepdim=True) + 0.9)

    def decode_all(self, latent: Latent) -> AffinePoints:
        affine = self.decode(latent)
        return replace(affine, normal=-functional.normalize(affine.points, dim=-1))


def wait_for_go() -> None:
    Path(os.environ["TINY_ENTERED"]).write_bytes(b".")
    with Path(os.environ["TINY_GO"]).open("rb", buffering=0) as go:
        go.read(1)


def load_tiny(name: str = "tiny", device: str = "cpu") -> GeometryModel:
    """The same weights each time; a stabilizer whose state clearly matters."""
    if name != "tiny":
        raise ValueError(f"model {name!r} is unknown, expected 'tiny'")
    model = TinyModel()
    model.stabilizer = build_dyfn(CHANNELS, DyFNConfig(hidden=8))
    rng = np.random.default_rng(7)  # not torch's: the same bits on every processor
    with torch.no_grad():
        for parameter in model.parameters():
            drawn = 0.25 * rng.standard_normal(parameter.shape)
            parameter.copy_(torch.from_numpy(drawn))
    return model.eval()
