"""The pure step of a model as an engine of TensorRT, for the GPU that it is made on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from dyfn_core.files import finished_file, write_text
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.export.step_file import Size, StepInfo, step_graph, text_of
from dyfn_core.models.formats import CheckpointError


class TensorRtError(ValueError):
    """No engine can be made here; the text says what is missing."""


def write_tensorrt_step(
    model: GeometryModel,
    path: Path,
    image_size: Size = (480, 640),
    num_tokens: int | None = None,
    stabilize: bool = True,
) -> StepInfo:
    """Write the pure step of a model as an engine in float32, and its metadata to PATH.json.

    Args:
        model: See step_graph.
        path: The engine, which is replaced if it exists.
        image_size: See step_graph.
        num_tokens: See step_graph.
        stabilize: See step_graph.

    Returns:
        What the metadata say.

    Raises:
        TensorRtError: No TensorRT, or no GPU.
        CheckpointError: The model has something that ONNX or TensorRT cannot say.
        OutputError: A file cannot be written.
    """
    library = _tensorrt()
    step, info = step_graph(model, image_size, num_tokens, stabilize)
    engine = _engine(library, step.SerializeToString())
    with finished_file(path) as partial:
        partial.write_bytes(engine)
    write_text(path.with_name(f"{path.name}.json"), text_of(info) + "\n")
    return info


def _tensorrt() -> Any:
    try:
        import tensorrt
    except ModuleNotFoundError as error:
        raise TensorRtError(
            "an engine of TensorRT needs its Python package, which is not installed: "
            "pip install tensorrt, on a machine with an NVIDIA GPU"
        ) from error
    if not torch.cuda.is_available():
        raise TensorRtError(
            f"an engine of TensorRT {tensorrt.__version__} is made on the NVIDIA GPU that runs it, "
            "and torch finds none here"
        )
    return tensorrt


def _engine(library: Any, step: bytes) -> bytes:
    logger = library.Logger(library.Logger.ERROR)
    builder = library.Builder(logger)
    explicit = getattr(library.NetworkDefinitionCreationFlag, "EXPLICIT_BATCH", None)
    network = builder.create_network(0 if explicit is None else 1 << int(explicit))
    parser = library.OnnxParser(network, logger)
    if not parser.parse(step):
        told = "; ".join(str(parser.get_error(index)) for index in range(parser.num_errors))
        raise CheckpointError(f"the step cannot be read by TensorRT: {told}")
    config = builder.create_builder_config()
    config.clear_flag(library.BuilderFlag.TF32)  # 10 bits of mantissa move the scale
    engine = builder.build_serialized_network(network, config)
    if engine is None:
        raise CheckpointError("TensorRT made no engine of the step; its log says why")
    return bytes(engine)
