"""Files of every known format -> configuration and weights.

The official MoGe and DyFN files ({"model_config", "model"} pickles), those of Depth Anything V2 (a
bare state dict), all loaded with weights_only=True; those of Depth Anything 3 (safetensors beside a
config.json), and ours, one .safetensors whose metadata holds the config as JSON.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from dyfn_core.models import depth_anything, depth_anything3
from dyfn_core.models.base import own_entries
from dyfn_core.models.dyfn import DyFNConfig
from dyfn_core.models.moge import MoGeConfig
from dyfn_core.models.moge2 import EncoderConfig, MoGe2Config

logger = logging.getLogger(__name__)

# Options of released configs that say what MoGe v1 does anyway.
LEGACY_TRUE = ("output_mask", "split_head")


class CheckpointError(ValueError):
    """A file that is no checkpoint, or one that does not fit its own description."""


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint in memory.

    config: the model's config ("type", the class's own keys, "stabilizer": dict or None).
    weights: the model's state dict. notes: other metadata of the file.
    official: parameter names in the file are the official ones.
    """

    config: dict[str, Any]
    weights: dict[str, Tensor]
    notes: dict[str, str]
    official: bool = False


def read_checkpoint(path: str | Path) -> Checkpoint:
    """A file of any known format. Raises FileNotFoundError or CheckpointError naming the file."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint file at {path}")
    if path.stat().st_size == 0:
        raise CheckpointError(f"{path} is empty")
    with path.open("rb") as stream:
        start = stream.read(9)
    # A zip (torch >= 1.6) or pickle opcode starts the one, a JSON header after 8 bytes the other.
    return _read_safetensors(path) if start[8:9] == b"{" else _read_official(path)


def _read_safetensors(path: Path) -> Checkpoint:
    try:
        with safe_open(str(path), framework="pt") as opened:
            metadata = opened.metadata() or {}
            weights = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is a damaged safetensors file: {error}") from error
    if "config" not in metadata:
        if any(key.startswith(depth_anything3.PREFIXES) for key in weights):
            return _depth_anything_3(weights, path)
        raise CheckpointError(
            f"{path} has no model config in its metadata: not written by save_model, nor a file of "
            "Depth Anything 3"
        )
    try:
        config = json.loads(metadata["config"])
    except json.JSONDecodeError as error:
        raise CheckpointError(f"{path}: the config in its metadata is no JSON: {error}") from error
    if not isinstance(config, dict):
        raise CheckpointError(f"{path}: the config in its metadata is no JSON object")
    notes = {key: value for key, value in metadata.items() if key not in ("format", "config")}
    return Checkpoint(config, weights, notes)


def _read_official(path: Path) -> Checkpoint:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever unpickling a stranger's bytes may raise
        raise CheckpointError(
            f"{path} is no checkpoint of a known format (a safetensors file of this project, or "
            "an official .pt that holds 'model_config' and 'model' and loads with "
            f"weights_only=True): {type(error).__name__}"
        ) from error
    if isinstance(content, dict) and any(str(key).startswith("pretrained.") for key in content):
        return _depth_anything(content, path)
    if not isinstance(content, dict) or not {"model_config", "model"} <= set(content):
        found = sorted(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise CheckpointError(
            f"{path} is no official checkpoint: expected 'model_config' and 'model', found {found}"
            " (nor is it Depth Anything V2, with 'pretrained.*' and 'depth_head.*')"
        )
    config, weights = content["model_config"], content["model"]
    if not isinstance(config, dict) or not isinstance(weights, dict):
        raise CheckpointError(f"{path}: 'model_config' and 'model' must be dictionaries")
    _only_tensors(weights, path)
    return Checkpoint(_from_official_config(config, path), weights, {}, official=True)


def _only_tensors(weights: dict[str, Any], path: Path) -> None:
    strange = [key for key, value in weights.items() if not isinstance(value, Tensor)]
    if strange:
        raise CheckpointError(f"{path}: weights that are no tensors: {strange}")


def _depth_anything(weights: dict[str, Any], path: Path) -> Checkpoint:
    """An official file of Depth Anything V2: a bare state dict whose sizes say which one."""
    _only_tensors(weights, path)
    try:
        encoder = depth_anything.official_encoder(weights)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error
    config = {"type": "depth_anything_v2", "encoder": encoder}
    return Checkpoint(config, weights, {}, official=True)


def _depth_anything_3(weights: dict[str, Tensor], path: Path) -> Checkpoint:
    """An official file of Depth Anything 3; which one, only config.json or a folder's name say."""
    supported = "supported are DA3MONO-LARGE and DA3METRIC-LARGE"
    other = [k for k in weights if not k.startswith(("model.backbone.pretrained.", "model.head."))]
    other += [k for k in weights if k.endswith("camera_token") or "_norm.weight" in k]
    if other:
        raise CheckpointError(
            f"{path} is a model of Depth Anything 3 for several views (it has {other[0]}), which "
            f"is not supported; {supported}"
        )
    kind = depth_anything3.official_kind(_texts(_json_beside(path)))
    kind = kind or depth_anything3.official_kind(path.absolute().parts)
    if kind is None:
        raise CheckpointError(
            f"{path} is Depth Anything 3, but neither a config.json beside it nor a folder's name "
            f"says whether mono or metric, which have the same weights' names; {supported}: put "
            "its config.json beside it"
        )
    try:
        encoder = depth_anything3.official_encoder(weights)
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error
    config = {"type": "depth_anything_3", "kind": kind, "encoder": encoder}
    return Checkpoint(config, weights, {}, official=True)


def _json_beside(path: Path) -> Any:
    """What config.json in the same folder holds; None without one."""
    beside = path.with_name("config.json")
    if not beside.is_file():
        return None
    try:
        return json.loads(beside.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{beside} is no JSON: {error}") from error


def _texts(value: Any) -> Iterator[str]:
    """Every string in a JSON value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _texts(inner)


def _from_official_config(config: dict[str, Any], path: Path) -> dict[str, Any]:
    if "neck" in config or isinstance(config.get("encoder"), dict):
        return _from_moge2_config(config, path)
    ours: dict[str, Any] = {"type": "moge", "stabilizer": None, **config}
    area = ours.pop("trained_area_range", None)
    if area is not None:
        ours["num_tokens_range"] = [int(limit) // 14**2 for limit in area]
    for key in LEGACY_TRUE:
        if not ours.pop(key, True):
            raise CheckpointError(f"{path}: a model with {key} = False is not supported")
    kind = ours.pop("stabilizer_type", None)
    if kind is not None:
        if not isinstance(kind, str) or kind.lower() not in ("convgru", "gru"):
            raise CheckpointError(f"{path}: stabilizer_type {kind!r} is unknown")
        ours["stabilizer"] = DyFNConfig(kind=kind.lower()).to_dict()
    own = _known_entries(own_entries(ours), MoGeConfig, path, "model_config")
    return {"type": ours["type"], "stabilizer": ours["stabilizer"], **own}


def _from_moge2_config(config: dict[str, Any], path: Path) -> dict[str, Any]:
    """Raises CheckpointError that names MoGe v2 and what of it is not supported."""
    encoder = config.get("encoder")
    if isinstance(encoder, dict):
        encoder = _known_entries(encoder, EncoderConfig, path, "model_config.encoder")
    own = _known_entries({**config, "encoder": encoder}, MoGe2Config, path, "model_config")
    try:
        return {"type": "moge2", "stabilizer": None, **MoGe2Config.from_dict(own).to_dict()}
    except ValueError as error:
        raise CheckpointError(f"{path} is MoGe v2, but no supported one: {error}") from error


def _known_entries(values: dict[str, Any], kind: type, path: Path, name: str) -> dict[str, Any]:
    known = {field.name for field in fields(kind)}
    for key in sorted(set(values) - known):
        logger.warning("%s: ignoring %s entry %s = %r", path, name, key, values[key])
    return {key: value for key, value in values.items() if key in known}
