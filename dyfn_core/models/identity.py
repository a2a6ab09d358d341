"""Which model a model is: its config and its fingerprint."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from dyfn_core.models.base import GeometryModel


def full_config(model: GeometryModel) -> dict[str, Any]:
    """The config of a model with its stabilizer; empty_model's input."""
    stabilizer = None if model.stabilizer is None else model.stabilizer.config.to_dict()
    return {**model.config, "stabilizer": stabilizer}


def model_fingerprint(model: GeometryModel) -> str:
    """SHA-256 of a model's configuration and weights; a different one is a different model.

    It does not depend on the library that runs the model.
    """
    model = model.plain
    digest = hashlib.sha256(json.dumps(full_config(model), sort_keys=True).encode())
    for name, value in sorted(model.state_dict().items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)};".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
