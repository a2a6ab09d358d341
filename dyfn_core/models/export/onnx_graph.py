"""Parts of a model -> ONNX graphs, and one graph of three parts."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path

import onnx
import torch
from onnx import compose

from dyfn_core.models.export.parts import LATENT, STABILIZED, SUMMARY, Part

OPSET = 17  # the first with LayerNormalization


def exported(part: Part) -> onnx.ModelProto:
    """A part as an ONNX graph whose inputs and outputs have the part's names.

    Every size is a constant. Raises RuntimeError for what has no ONNX counterpart.
    """
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of constant sizes, and of the exporter's age
        path = Path(folder) / "part.onnx"
        with torch.inference_mode(False), torch.no_grad():
            torch.onnx.export(
                part.eval(),
                tuple(value.clone() for value in part.inputs.values()),
                str(path),
                input_names=list(part.inputs),
                output_names=list(part.outputs),
                opset_version=OPSET,
                dynamo=False,
            )
        return onnx.load(str(path))


def joined(
    encode: onnx.ModelProto, stabilize: onnx.ModelProto | None, decode: onnx.ModelProto
) -> onnx.ModelProto:
    """The whole step of its parts; without `stabilize`, of the base model.

    LATENT, STABILIZED and SUMMARY stay the names of what goes from part to part.
    """
    parts = [_prefixed(encode, "encode/")]
    if stabilize is not None:
        parts.append(_prefixed(stabilize, "stabilize/"))
    last = _prefixed(decode, "decode/")
    if stabilize is not None:
        _rename_input(last, LATENT, STABILIZED)
    parts.append(last)
    inside = {LATENT, STABILIZED, SUMMARY}
    graph = onnx.GraphProto(name="step")
    for part in parts:
        graph.node.extend(part.node)
        graph.initializer.extend(part.initializer)
        graph.value_info.extend(part.value_info)
        graph.value_info.extend(value for value in part.output if value.name in inside)
        graph.input.extend(value for value in part.input if value.name not in inside)
    for part in reversed(parts):  # what the decoder gives comes first
        graph.output.extend(value for value in part.output if value.name not in inside)
    return onnx.helper.make_model(
        graph, opset_imports=encode.opset_import, ir_version=encode.ir_version
    )


def _prefixed(model: onnx.ModelProto, prefix: str) -> onnx.GraphProto:
    """A graph whose inner names begin with the prefix; inputs and outputs keep theirs."""
    return compose.add_prefix(model, prefix, rename_inputs=False, rename_outputs=False).graph


def _rename_input(graph: onnx.GraphProto, old: str, new: str) -> None:
    for value in graph.input:
        value.name = new if value.name == old else value.name
    for node in graph.node:
        node.input[:] = [new if name == old else name for name in node.input]
