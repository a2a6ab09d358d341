"""Every known checkpoint format in, one format out; models by name, path or Hub id.

In: the official MoGe v1 and DyFN files ({"model_config", "model"} pickles), those of Depth
Anything V2 (a bare state dict), all loaded with weights_only=True, and ours. Out: ours, one
.safetensors whose metadata holds the config as JSON.
Loading is strict: a key that is missing, left over or of another shape is an error.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import logging
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from dyfn_core.files import finished_file
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.depth_anything import DepthAnythingModel, official_encoder
from dyfn_core.models.device import resolve_device
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.mini import MiniModel
from dyfn_core.models.moge import MoGeConfig, MoGeModel

logger = logging.getLogger(__name__)

MODEL_TYPES: dict[str, type[GeometryModel]] = {
    "depth_anything_v2": DepthAnythingModel,
    "mini": MiniModel,
    "moge": MoGeModel,
}
BUNDLED = {
    "dyfn-mini": "dyfn-mini-8.safetensors",
    "dyfn-mini-5": "dyfn-mini.safetensors",  # the default before
    "dyfn-mini-6": "dyfn-mini-6.safetensors",
    "dyfn-mini-7": "dyfn-mini-7.safetensors",
    "dyfn-mini-8": "dyfn-mini-8.safetensors",  # the default by its version
}
# SHA-256 of the bundled files, which are checked when they are loaded.
BUNDLED_SHA256 = {
    "dyfn-mini-6.safetensors": "c42f9390e858be7998bf96bae6f76ed1eedde96a0fd2326055346a0c7fbf4294",
    "dyfn-mini-7.safetensors": "43d8c84c699ce9bd794b78c60f2fb079f399e87457fa939b8825f0d8caafa9c1",
    "dyfn-mini-8.safetensors": "4ac799e188ca029b6c319573c200cccc733dbba6e89ceb299d64ffdbd01b7abe",
    "dyfn-mini.safetensors": "69db69fa6c46167625f787b94deccf87b492c8b58ed993385304d190a4dec08a",
}
HUB_FILES = {
    "shawlyu/dyfn": "DyFN.pt",
    "depth-anything/depth-anything-v2-small": "depth_anything_v2_vits.pth",
    "depth-anything/depth-anything-v2-base": "depth_anything_v2_vitb.pth",
    "depth-anything/depth-anything-v2-large": "depth_anything_v2_vitl.pth",
}
HUB_DEFAULT = "model.pt"
OFFICIAL_STABILIZER = "head.stabilizer."
# Options of released configs that say what MoGe v1 does anyway.
LEGACY_TRUE = ("output_mask", "split_head")
FORMAT = "dyfn"

_HUB_ID = re.compile(r"(?P<repo>[\w.-]+/[\w.-]+)(/(?P<file>.+))?")


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


def load_model(name_or_path: str | Path, device: torch.device | str = "cpu") -> GeometryModel:
    """A trained model, in eval mode, float32.

    Args:
        name_or_path: "dyfn-mini" (bundled), a file, or a Hub id such as "shawlyu/DyFN" or
            "Ruicheng/moge-vitl", optionally with "/file".
        device: a torch device or its name; "auto" takes a GPU if there is one.

    Returns:
        The model. `model.stabilizer` is its DyFN module, None for a plain base model.

    Raises:
        FileNotFoundError: no such file; or no network, then saying what to download and where to
            put it.
        CheckpointError: no checkpoint, or keys that do not fit, all listed; a bundled file with
            other bytes than it was released with; weights that are not finite.
        ValueError: no such device.

    Example:
        >>> model = load_model("dyfn-mini")
        >>> model.quantity, model.stabilizer is not None
        ('depth', True)
    """
    name, device = os.fspath(name_or_path), resolve_device(device)
    if name in BUNDLED and not Path(name).exists():
        with as_file(files("dyfn_core") / "weights" / BUNDLED[name]) as path:
            if not path.exists():
                raise FileNotFoundError(f"the bundled model {name!r} is not installed: no {path}")
            _check_digest(path, BUNDLED_SHA256[BUNDLED[name]])
            return build_model(read_checkpoint(path), str(path)).to(device)
    path = _locate(name)
    return build_model(read_checkpoint(path), str(path)).to(device)


def _check_digest(path: Path, expected: str) -> None:
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != expected:
        raise CheckpointError(
            f"{path} is damaged: its SHA-256 is {found}, expected {expected}; install it again"
        )


def build_model(checkpoint: Checkpoint, source: str) -> GeometryModel:
    """Checkpoint -> model in eval mode. Raises CheckpointError that names `source`."""
    with torch.device("meta"):  # the weights replace every parameter: no need to draw them first
        model = empty_model(checkpoint.config, source)
    if {name for name, _ in model.named_buffers()} - set(model.state_dict()):
        model = empty_model(checkpoint.config, source)
    load_weights(model, checkpoint.weights, source, checkpoint.official)
    return model.eval()


def empty_model(config: Mapping[str, Any], source: str = "config") -> GeometryModel:
    """The untrained model that a config describes. Raises CheckpointError naming `source`."""
    kind = config.get("type")
    if kind not in MODEL_TYPES:
        raise CheckpointError(
            f"{source}: model type {kind!r} is unknown, expected one of {sorted(MODEL_TYPES)}"
            + _near(str(kind), MODEL_TYPES)
        )
    try:
        model = MODEL_TYPES[kind].from_config(dict(config))
        if config.get("stabilizer") is not None:
            described = DyFNConfig(**config["stabilizer"])
            model.stabilizer = build_dyfn(model.latent_channels, described)
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{source}: bad model config: {error}") from error
    return model


def full_config(model: GeometryModel) -> dict[str, Any]:
    """The config of a model with its stabilizer; empty_model's input."""
    stabilizer = None if model.stabilizer is None else model.stabilizer.config.to_dict()
    return {**model.config, "stabilizer": stabilizer}


def model_fingerprint(model: GeometryModel) -> str:
    """SHA-256 of a model's configuration and weights; a different one is a different model."""
    digest = hashlib.sha256(json.dumps(full_config(model), sort_keys=True).encode())
    for name, value in sorted(model.state_dict().items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)};".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def load_weights(
    model: GeometryModel, weights: Mapping[str, Tensor], source: str, official: bool = False
) -> None:
    """Put weights into a model of the same shape, in its dtype; all of them or none.

    official: the names are those of released files ("head.stabilizer.*").
    Raises CheckpointError that lists every missing, unexpected and wrongly shaped key, and those
    whose values are not finite.
    """
    own = model.state_dict()
    expected = {_official_name(key) if official else key: value for key, value in own.items()}
    missing = {key: value for key, value in expected.items() if key not in weights}
    problems = [f"missing: {key} ({_shape(value)})" for key, value in missing.items()]
    problems += [
        f"unexpected: {key} ({_shape(value)}){_near(key, missing)}"
        for key, value in weights.items()
        if key not in expected
    ]
    problems += [
        f"wrong shape: {key} is {_shape(weights[key])}, expected {_shape(value)}"
        for key, value in expected.items()
        if key in weights and weights[key].shape != value.shape
    ]
    problems += [
        f"not finite: {key} ({_shape(value)})"
        for key, value in weights.items()
        if value.is_floating_point() and not torch.isfinite(value).all()
    ]
    if problems:
        listed = "\n  ".join(problems)
        raise CheckpointError(f"{source} does not fit its model config:\n  {listed}")
    names = dict(zip(expected, own, strict=True))
    fitting = {names[key]: value.to(expected[key].dtype) for key, value in weights.items()}
    on_meta = any(value.is_meta for value in own.values())
    model.load_state_dict(fitting, assign=on_meta)


def save_model(
    model: GeometryModel,
    path: str | Path,
    dtype: torch.dtype | None = None,
    notes: Mapping[str, str] | None = None,
) -> None:
    """Write a model to a .safetensors file, whole or not at all; load_model reads it again.

    Args:
        model: The model. Its config goes into the file's metadata.
        path: The file, which is replaced if it exists.
        dtype: Type of the stored floating-point weights (torch.float16 halves the file); None:
            as they are.
        notes: Further metadata, string to string; "format" and "config" are taken.
    """
    weights = {
        key: value.detach().to("cpu", dtype if value.is_floating_point() else None).contiguous()
        for key, value in model.state_dict().items()
    }
    metadata = {
        **(notes or {}),
        "format": f"{FORMAT} 1",
        "config": json.dumps(full_config(model), sort_keys=True),
    }
    with finished_file(Path(path)) as partial:
        save_file(weights, partial, metadata)
        partial.chmod(0o644)  # safetensors makes files for their owner alone


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
        raise CheckpointError(
            f"{path} has no model config in its metadata: not written by save_model"
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
        config = {"type": "depth_anything_v2", "encoder": official_encoder(weights)}
    except ValueError as error:
        raise CheckpointError(f"{path}: {error}") from error
    return Checkpoint(config, weights, {}, official=True)


def _from_official_config(config: dict[str, Any], path: Path) -> dict[str, Any]:
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
    known = {field.name for field in fields(MoGeConfig)} | {"type", "stabilizer"}
    for key in sorted(set(ours) - known):
        logger.warning("%s: ignoring model_config entry %s = %r", path, key, ours.pop(key))
    return ours


def _near(name: str, names: Iterable[str]) -> str:
    found = difflib.get_close_matches(name, list(names), n=1, cutoff=0.8)
    return f", did you mean {found[0]!r}?" if found else ""


def _official_name(key: str) -> str:
    own = "stabilizer."
    return OFFICIAL_STABILIZER + key[len(own) :] if key.startswith(own) else key


def _shape(tensor: Tensor) -> str:
    return "x".join(map(str, tensor.shape)) or "a scalar"


def _locate(name: str) -> Path:
    path = Path(name).expanduser()
    if path.exists():
        return path
    match = _HUB_ID.fullmatch(name)
    is_weights = path.suffix in (".pt", ".pth", ".safetensors")
    is_file_name = is_weights and (name.count("/") < 2 or Path(path.parts[0]).is_dir())
    if match is None or is_file_name:
        raise FileNotFoundError(
            f"no model {name!r}: no file of that path, no bundled model "
            f"({', '.join(BUNDLED)}) and no Hub id (owner/name)"
        )
    repo = match["repo"]
    return _from_hub(repo, match["file"] or HUB_FILES.get(repo.lower(), HUB_DEFAULT))


def model_folder() -> Path:
    """Where files downloaded by hand are looked for: $DYFN_MODELS or ~/.cache/dyfn/models."""
    chosen = os.environ.get("DYFN_MODELS")
    return Path(chosen) if chosen else Path.home() / ".cache" / "dyfn" / "models"


def _from_hub(repo: str, file: str) -> Path:
    by_hand = model_folder() / repo / file
    if by_hand.is_file():
        return by_hand
    from huggingface_hub import hf_hub_download, hf_hub_url, try_to_load_from_cache

    cached = try_to_load_from_cache(repo, file)
    if isinstance(cached, str):
        return Path(cached)
    logger.info("fetching %s of %s from the Hub", file, repo)
    try:
        return Path(hf_hub_download(repo_id=repo, filename=file))
    except Exception as error:  # many kinds, by version: no network, no such file, no access
        raise FileNotFoundError(
            f"no such file here, and cannot download {file} of Hub model {repo} "
            f"({type(error).__name__}: {error}). "
            f"Download {hf_hub_url(repo, file)} on a machine with a network and put it at "
            f"{by_hand} (or anywhere, and pass its path)"
        ) from error
