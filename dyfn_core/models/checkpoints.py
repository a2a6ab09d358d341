"""Every known checkpoint format in, one format out; models by name, path or Hub id.

In: what dyfn_core.models.formats reads. Out: ours, one .safetensors whose metadata holds the config
as JSON.
Loading is strict: a key that is missing, left over or of another shape is an error.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from dyfn_core.files import finished_file
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.depth_anything import DepthAnythingModel
from dyfn_core.models.depth_anything3 import DepthAnything3Model
from dyfn_core.models.device import resolve_device
from dyfn_core.models.dyfn import DyFNConfig, build_dyfn
from dyfn_core.models.formats import Checkpoint as Checkpoint
from dyfn_core.models.formats import CheckpointError as CheckpointError
from dyfn_core.models.formats import read_checkpoint as read_checkpoint
from dyfn_core.models.hub_files import WEIGHTS, Asked, is_hub_id, locate
from dyfn_core.models.hub_files import model_folder as model_folder
from dyfn_core.models.identity import full_config as full_config
from dyfn_core.models.identity import model_fingerprint as model_fingerprint
from dyfn_core.models.mini import MiniModel
from dyfn_core.models.moge import MoGeModel
from dyfn_core.models.moge2 import MoGe2Model
from dyfn_core.models.undrawn import Undrawn

MODEL_TYPES: dict[str, type[GeometryModel]] = {
    "depth_anything_3": DepthAnything3Model,
    "depth_anything_v2": DepthAnythingModel,
    "mini": MiniModel,
    "moge": MoGeModel,
    "moge2": MoGe2Model,
}
BUNDLED = {
    "dyfn-mini": "dyfn-mini-9.safetensors",
    "dyfn-mini-5": "dyfn-mini.safetensors",
    "dyfn-mini-6": "dyfn-mini-6.safetensors",
    "dyfn-mini-7": "dyfn-mini-7.safetensors",
    "dyfn-mini-8": "dyfn-mini-8.safetensors",  # the default before
    "dyfn-mini-9": "dyfn-mini-9.safetensors",  # the default by its version
}
# SHA-256 of the bundled files, which are checked when they are loaded.
BUNDLED_SHA256 = {
    "dyfn-mini-6.safetensors": "c42f9390e858be7998bf96bae6f76ed1eedde96a0fd2326055346a0c7fbf4294",
    "dyfn-mini-7.safetensors": "43d8c84c699ce9bd794b78c60f2fb079f399e87457fa939b8825f0d8caafa9c1",
    "dyfn-mini-8.safetensors": "4ac799e188ca029b6c319573c200cccc733dbba6e89ceb299d64ffdbd01b7abe",
    "dyfn-mini-9.safetensors": "c0d302cfb248cb4a373b18de9fc28a7b27e8cf4e4eabdb52b37409d2ce0ae3d9",
    "dyfn-mini.safetensors": "69db69fa6c46167625f787b94deccf87b492c8b58ed993385304d190a4dec08a",
}
OFFICIAL_STABILIZER = "head.stabilizer."
FORMAT = "dyfn"


def load_model(
    name_or_path: str | Path, device: torch.device | str = "cpu", backend: str = "torch"
) -> GeometryModel:
    """A trained model, in eval mode, float32.

    Args:
        name_or_path: "dyfn-mini" (bundled), a file, a folder with a model.safetensors, or a Hub
            id such as "shawlyu/DyFN" or "Ruicheng/moge-vitl", optionally with "/file".
        device: a torch device or its name; "auto" takes a GPU if there is one.
        backend: the library that runs the network: "torch", "onnxruntime", "openvino", "tensorrt",
            "compile"; "auto" takes the fastest that is installed (docs/models.md).

    Returns:
        The model. `model.stabilizer` is its DyFN module, None for a plain base model.

    Raises:
        FileNotFoundError: no such file; or no network, then saying what to download and where to
            put it.
        CheckpointError: no checkpoint, or keys that do not fit, all listed; a bundled file with
            other bytes than it was released with; weights that are not finite.
        ValueError: no such device or backend, or one that is not installed.

    Example:
        >>> model = load_model("dyfn-mini")
        >>> model.quantity, model.stabilizer is not None
        ('depth', True)
    """
    from dyfn_core.models.export.backends import on_backend

    device = resolve_device(device)
    return on_backend(_read_model(os.fspath(name_or_path)).to(device), backend)


def _read_model(name: str) -> GeometryModel:
    if name in BUNDLED and not Path(name).exists():
        with as_file(files("dyfn_core") / "weights" / BUNDLED[name]) as path:
            if not path.exists():
                raise FileNotFoundError(f"the bundled model {name!r} is not installed: no {path}")
            _check_digest(path, BUNDLED_SHA256[BUNDLED[name]])
            return build_model(read_checkpoint(path), str(path))
    path = find_checkpoint(name)
    return build_model(read_checkpoint(path), str(path))


def _check_digest(path: Path, expected: str) -> None:
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != expected:
        raise CheckpointError(
            f"{path} is damaged: its SHA-256 is {found}, expected {expected}; install it again"
        )


def build_model(checkpoint: Checkpoint, source: str) -> GeometryModel:
    """Checkpoint -> model in eval mode. Raises CheckpointError that names `source`."""
    with torch.device("meta"), Undrawn():  # the weights replace every parameter
        model = empty_model(checkpoint.config, source)
    if {name for name, _ in model.named_buffers()} - set(model.state_dict()):
        with Undrawn():
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
    model = model.plain
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


def _near(name: str, names: Iterable[str]) -> str:
    found = difflib.get_close_matches(name, list(names), n=1, cutoff=0.8)
    return f", did you mean {found[0]!r}?" if found else ""


def _official_name(key: str) -> str:
    own = "stabilizer."
    return OFFICIAL_STABILIZER + key[len(own) :] if key.startswith(own) else key


def _shape(tensor: Tensor) -> str:
    return "x".join(map(str, tensor.shape)) or "a scalar"


def find_checkpoint(name: str, asked: Asked | None = None) -> Path:
    """The file that a path, a folder or a Hub id stands for, fetched if need be.

    asked: how the Hub is asked. Raises FileNotFoundError or CheckpointError.
    """
    path = Path(name).expanduser()
    if path.is_dir():
        return path / WEIGHTS
    if path.exists():
        return path
    is_weights = path.suffix in (".pt", ".pth", ".safetensors")
    is_file_name = is_weights and (name.count("/") < 2 or Path(path.parts[0]).is_dir())
    if is_file_name or not is_hub_id(name):
        raise FileNotFoundError(
            f"no model {name!r}: no file of that path, no bundled model "
            f"({', '.join(BUNDLED)}) and no Hub id (owner/name)"
        )
    return locate(name, asked)
