"""In which library a model runs, by name."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from typing import Any

import torch

from dyfn_core.argument_types import BACKENDS
from dyfn_core.extras import missing
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.export.backed_model import BackedModel, MakeRunner, Runner
from dyfn_core.models.export.folder import export_folder
from dyfn_core.models.export.parts import Part

logger = logging.getLogger(__name__)

TORCH, AUTO = "torch", "auto"
FASTEST = {"cpu": ("onnxruntime", "openvino"), "cuda": ("tensorrt",)}  # what auto tries, in order


class BackendError(ValueError):
    """A backend cannot be used here; the text says why."""


def on_backend(model: GeometryModel, backend: str) -> GeometryModel:
    """The same model in another library.

    Args:
        model: As load_model gives it, in torch.
        backend: One of BACKENDS. "auto" takes the fastest that is installed, and logs which.

    Returns:
        The model itself for "torch", else one whose encoder, DyFN and decoder run there. State,
        fingerprint and everything after the network are the same.

    Raises:
        BackendError: There is no such backend, it is not installed, or not for the model's device.
    """
    if backend == AUTO:
        backend = fastest(model.device.type)
        logger.info("backend auto: %s", backend)
    if backend == TORCH:
        return model
    if backend not in BACKENDS:
        raise BackendError(f"backend {backend!r} is unknown, expected one of {', '.join(BACKENDS)}")
    logger.info("backend %s; exported parts are kept in %s", backend, export_folder())
    return BackedModel(model, backend, runner_of(backend, model.device))


def kept_exports(model: GeometryModel) -> str:
    """Where the exported parts of a model are kept, for a log; "" for one without."""
    keeps = model.backend not in (TORCH, "compile")
    return f" (exported parts are kept in {export_folder()})" if keeps else ""


def fastest(device: str) -> str:
    """The first of FASTEST that can be used here, else torch. device: its type."""
    for name in FASTEST.get(device, ()):
        try:
            runner_of(name, torch.device(device))
        except BackendError:
            continue
        return name
    return TORCH


def runner_of(backend: str, device: torch.device) -> MakeRunner:
    """How a backend makes a part ready to run. Raises BackendError where it cannot be used."""
    made: dict[str, Callable[[torch.device], MakeRunner]] = {
        "onnxruntime": _onnxruntime,
        "openvino": _openvino,
        "tensorrt": _tensorrt,
        "compile": _compile,
    }
    try:
        return made[backend](device)
    except ModuleNotFoundError as error:
        raise BackendError(f"backend {backend!r}: {missing(error)}") from error


def _onnxruntime(device: torch.device) -> MakeRunner:
    from dyfn_core.models.export.session import CPU, CUDA, OnnxSession, graph_of, offered

    providers = CUDA if device.type == "cuda" else CPU
    if device.type not in ("cpu", "cuda") or providers[0] not in offered():
        raise BackendError(
            f"backend 'onnxruntime': the device is {device}, for which this onnxruntime has no "
            f"provider ({', '.join(offered())}); give device cpu, or install onnxruntime-gpu"
        )
    return lambda part, made_of: OnnxSession(graph_of(part, made_of), providers=providers)


def _tensorrt(device: torch.device) -> MakeRunner:
    from dyfn_core.models.export.session import TENSORRT, OnnxSession, graph_of, offered

    if device.type != "cuda" or TENSORRT[0] not in offered():
        raise BackendError(
            "backend 'tensorrt' needs an NVIDIA GPU as device, TensorRT and onnxruntime-gpu; the "
            f"device is {device}, onnxruntime offers {', '.join(offered())}"
        )
    return lambda part, made_of: OnnxSession(graph_of(part, made_of), providers=TENSORRT)


def _openvino(device: torch.device) -> MakeRunner:
    from dyfn_core.models.export.openvino_graph import OpenVinoGraph
    from dyfn_core.models.export.session import graph_of

    if device.type != "cpu":
        raise BackendError(f"backend 'openvino' runs on the CPU, the device is {device}")
    return lambda part, made_of: OpenVinoGraph(graph_of(part, made_of))


def _compile(device: torch.device) -> MakeRunner:
    from dyfn_core.models.export.compiled import CompiledPart

    if device.type == "cpu" and not any(map(shutil.which, ("g++", "clang++", "c++"))):
        raise BackendError("backend 'compile' needs a C++ compiler on the CPU: g++ or clang++")

    def make(part: Part, made_of: dict[str, Any]) -> Runner:
        return CompiledPart(part)

    return make
