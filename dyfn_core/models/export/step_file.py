"""The pure step of a model as an ONNX graph that says what it is, and as a file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import onnx
import torch

from dyfn_core import __version__
from dyfn_core.files import finished_file
from dyfn_core.models.base import GeometryModel, Latent, Prepared, plane
from dyfn_core.models.export.onnx_graph import exported, joined
from dyfn_core.models.export.parts import (
    decode_part,
    encode_part,
    stabilize_part,
    state_tensors,
)
from dyfn_core.models.formats import CheckpointError
from dyfn_core.models.identity import full_config, model_fingerprint
from dyfn_core.prediction import StreamState

KEY = "dyfn_ros"  # of the file's metadata
FORMAT = 1
FIRST_STATE = {"hidden": "zeros", "ema_mean": "NaN", "ema_std": "NaN"}

Size = tuple[int, int]


@dataclass(frozen=True)
class StepInfo:
    """What a step file says of itself, as JSON under KEY of its metadata.

    version: of dyfn_ros that wrote it. weights: SHA-256, see model_fingerprint. model: the config.
    image_size: (H, W) of the camera's image, and of what comes out. prepared_size: (H, W) of the
    input `image`. network_size: see Latent. num_tokens: None is the model's own. preparation: how
    the input is made of the camera's image, RGB in 0..1. state: shapes of the inputs by name; the
    outputs have NEXT before the name. first_state: what a stream begins with. metres_of_focal:
    see AffineDepth. precision: "int8" where layers compute in 8 bits. The other fields: see
    GeometryModel.
    """

    version: str
    weights: str
    model: dict[str, Any]
    image_size: Size
    prepared_size: Size
    network_size: Size
    num_tokens: int | None
    preparation: str
    quantity: str
    mask_threshold: float
    state: dict[str, list[int]]
    first_state: dict[str, str]
    metres_of_focal: tuple[float, float] | None = None
    precision: str = "float32"
    format: int = FORMAT

    @property
    def stabilized(self) -> bool:
        """Whether DyFN is in the step."""
        return bool(self.state)


def write_step(
    model: GeometryModel,
    path: str | Path,
    image_size: Size = (480, 640),
    num_tokens: int | None = None,
    stabilize: bool = True,
) -> StepInfo:
    """Write the pure step of a model to an ONNX file, whole or not at all.

    Args:
        model: See step_graph.
        path: The file, which is replaced if it exists.
        image_size: See step_graph.
        num_tokens: See step_graph.
        stabilize: See step_graph.

    Returns:
        What the file says of itself.

    Raises:
        CheckpointError: The model has something that ONNX cannot say.
        OutputError: The file cannot be written.
    """
    step, info = step_graph(model, image_size, num_tokens, stabilize)
    with finished_file(Path(path)) as partial:
        onnx.save(step, str(partial))
    return info


def step_graph(
    model: GeometryModel,
    image_size: Size = (480, 640),
    num_tokens: int | None = None,
    stabilize: bool = True,
) -> tuple[onnx.ModelProto, StepInfo]:
    """The pure step of a model as an ONNX graph.

    Args:
        model: On the CPU, float32.
        image_size: (H, W) of the camera's images.
        num_tokens: Resolution inside the model; None is the model's own.
        stabilize: False for the base model; one without DyFN has no other step.

    Returns:
        The graph with its metadata, and what they say.

    Raises:
        CheckpointError: The model has something that ONNX cannot say.
    """
    with torch.inference_mode():
        prepared = model.prepare(torch.zeros(1, 3, *image_size), num_tokens)
        latent = model.encode_prepared(prepared)
        changed, state = model.stabilized(latent, None, stabilize)
    encode, decode = encode_part(model, prepared), decode_part(model, changed)
    try:
        dyfn = None
        if model.stabilizer is not None and state is not None:
            dyfn = exported(stabilize_part(model.stabilizer, latent.features))
        step = joined(exported(encode), dyfn, exported(decode))
    except RuntimeError as error:
        kind = full_config(model)["type"]
        raise CheckpointError(f"a model of type {kind!r} cannot be exported: {error}") from error
    info = _info(model, prepared, changed, state, num_tokens)
    onnx.helper.set_model_props(step, {KEY: text_of(info)})
    return step, info


def _info(
    model: GeometryModel,
    prepared: Prepared,
    latent: Latent,
    state: StreamState | None,
    num_tokens: int | None,
) -> StepInfo:
    """latent, state: what goes into the decoder, and DyFN's state after a frame."""
    shapes = {} if state is None else state_tensors(state)
    return StepInfo(
        version=__version__,
        weights=model_fingerprint(model),
        model=full_config(model),
        image_size=prepared.image_size,
        prepared_size=plane(prepared.pixels),
        network_size=latent.network_size,
        num_tokens=num_tokens,
        preparation=model.preparation,
        quantity=model.quantity,
        mask_threshold=model.mask_threshold,
        state={name: list(value.shape) for name, value in shapes.items()},
        first_state={name: FIRST_STATE[name] for name in shapes},
        metres_of_focal=model.metres_of_focal(latent.network_size),
    )


def text_of(info: StepInfo) -> str:
    """The JSON that info_of reads."""
    return json.dumps(asdict(info), sort_keys=True)


def info_of(metadata: Mapping[str, str], source: str) -> StepInfo:
    """What a file's metadata say. Raises CheckpointError naming the source when it is no step."""
    if KEY not in metadata:
        raise CheckpointError(
            f"{source} is no step of a model: its metadata have no {KEY!r}; dyfn-export writes one"
        )
    try:
        values = json.loads(metadata[KEY])
        if values.get("format") != FORMAT:
            raise CheckpointError(
                f"{source} has format {values.get('format')}, expected {FORMAT}: export it again"
            )
        for name in ("image_size", "prepared_size", "network_size", "metres_of_focal"):
            values[name] = values[name] and tuple(values[name])
        return StepInfo(**{field.name: values[field.name] for field in fields(StepInfo)})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{source}: its metadata {KEY!r} are damaged: {error!r}") from error
