"""Image -> latent -> (DyFN) -> latent -> points."""

from dyfn_core.models.base import AffinePoints, GeometryModel, Latent
from dyfn_core.models.checkpoints import (
    CheckpointError,
    load_model,
    model_fingerprint,
    save_model,
)
from dyfn_core.models.device import resolve_device

__all__ = [
    "AffinePoints",
    "CheckpointError",
    "GeometryModel",
    "Latent",
    "load_model",
    "model_fingerprint",
    "resolve_device",
    "save_model",
]
