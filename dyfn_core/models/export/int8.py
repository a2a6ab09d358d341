"""A step file with 8-bit convolutions, calibrated on the inputs of a stream."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import (
    CalibrationDataReader,
    QuantFormat,
    QuantType,
    quantize_static,
)
from onnxruntime.quantization.shape_inference import quant_pre_process

from dyfn_core.files import finished_file
from dyfn_core.models.export.parts import LATENT
from dyfn_core.models.export.step_file import KEY, info_of, text_of

INT8 = "int8"
FIRST = 7  # layers of the encoder that stay float32: their maps span the widest ranges
NEAR = 3  # layers before the latent, and before each output, that stay float32
# What may be 8 bits, the most first: beginnings of nodes' names. DyFN never is.
CHOICES = {
    "encoder and decoder": ("encode/", "decode/"),
    "encoder": ("encode/",),
    "decoder": ("decode/",),
}
LAYERS = ("Conv", "MatMul")


class _Feeds(CalibrationDataReader):  # type: ignore[misc]
    def __init__(self, feeds: Iterable[dict[str, np.ndarray]]) -> None:
        self._feeds: Iterator[dict[str, np.ndarray]] = iter(feeds)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """See CalibrationDataReader."""
        return next(self._feeds, None)


def quantize(
    step: Path, out: Path, feeds: Iterable[dict[str, np.ndarray]], beginnings: tuple[str, ...]
) -> int:
    """Write a step whose convolutions and matrix products compute in 8 bits.

    Static, quantized and dequantized around each layer, weights per channel.

    Args:
        step: A file of write_step.
        out: The file to write.
        feeds: Inputs of the step over a stream, for the ranges.
        beginnings: A value of CHOICES.

    Returns:
        How many layers are 8 bits.
    """
    with tempfile.TemporaryDirectory() as folder:
        plain, found = Path(folder) / "plain.onnx", Path(folder) / "int8.onnx"
        quant_pre_process(str(step), str(plain), skip_symbolic_shape=True)
        graph = onnx.load(str(plain))
        exact = kept_exact(graph.graph, beginnings)
        quantize_static(
            str(plain),
            str(found),
            _Feeds(feeds),
            quant_format=QuantFormat.QDQ,
            op_types_to_quantize=list(LAYERS),
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_exclude=exact,
        )
        made = onnx.load(str(found))
    source = {entry.key: entry.value for entry in onnx.load(str(step)).metadata_props}
    info = replace(info_of(source, str(step)), precision=INT8)
    onnx.helper.set_model_props(made, {KEY: text_of(info)})
    with finished_file(out) as partial:
        onnx.save(made, str(partial))
    layers = [node for node in graph.graph.node if node.op_type in LAYERS]
    return len(layers) - len(exact)


def kept_exact(graph: onnx.GraphProto, beginnings: tuple[str, ...]) -> list[str]:
    """Names of the layers that stay float32.

    Those of other parts, the encoder's FIRST, the NEAR before the latent and before each output,
    and convolutions of single channels, whose ranges differ most from channel to channel.
    """
    layers = [node for node in graph.node if node.op_type in LAYERS]
    near = _last_layers(graph, [LATENT, *(value.name for value in graph.output)])
    first = [node.name for node in layers if node.name.startswith("encode/")][:FIRST]
    exact = {*near, *first}
    return [
        node.name
        for node in layers
        if node.name in exact or _groups(node) > 1 or not node.name.startswith(beginnings)
    ]


def _groups(node: onnx.NodeProto) -> int:
    return next((int(entry.i) for entry in node.attribute if entry.name == "group"), 1)


def _last_layers(graph: onnx.GraphProto, tensors: list[str]) -> set[str]:
    """Layers with fewer than NEAR others between them and one of the tensors."""
    maker = {name: node for node in graph.node for name in node.output}
    found: set[str] = set()
    waiting = [(name, NEAR) for name in tensors]
    seen: dict[str, int] = {}
    while waiting:
        name, left = waiting.pop()
        if left == 0 or name not in maker or seen.get(name, 0) >= left:
            continue
        seen[name] = left
        node = maker[name]
        is_layer = node.op_type in LAYERS
        if is_layer:
            found.add(node.name)
        waiting += [(before, left - is_layer) for before in node.input]
    return found
