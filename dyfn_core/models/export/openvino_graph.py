"""A graph of named tensors in OpenVINO, from the same ONNX file or from one of its own."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import openvino
import torch

from dyfn_core.models.export.parts import NAMES, NEXT, Tensors
from dyfn_core.models.export.step_file import KEY
from dyfn_core.models.formats import CheckpointError


class OpenVinoGraph:
    """An ONNX graph or one of OpenVINO's own files, ready to run on the CPU in float32.

    Attributes:
        inputs: Names of what goes in.
        outputs: Names of what comes out.
        metadata: What a file of openvino_file says of itself; empty for ONNX graphs.
    """

    def __init__(self, source: Path | bytes, threads: int = 0) -> None:
        """Load a graph.

        Args:
            source: A file, or a file's content.
            threads: CPU threads; 0 takes as many as torch computes with now.

        Raises:
            CheckpointError: It cannot be read, or has something that OpenVINO does not know.
        """
        settings = {
            "INFERENCE_NUM_THREADS": threads or torch.get_num_threads(),
            "INFERENCE_PRECISION_HINT": "f32",  # else bfloat16 where the CPU has it
            "PERFORMANCE_HINT": "LATENCY",
            # Attention joined into one kernel is wrong by 2% for 6 tokens (OpenVINO 2026.4).
            "SNIPPETS_MODE": "DISABLE",
        }
        try:
            graph = read_graph(source)
            self._request = _core().compile_model(graph, "CPU", settings).create_infer_request()
        except Exception as error:
            name = "an ONNX graph" if isinstance(source, bytes) else source
            raise CheckpointError(f"{name} cannot be loaded by OpenVINO: {error}") from error
        known = graph.get_rt_info().keys()
        self.metadata = {KEY: graph.get_rt_info([KEY]).astype(str)} if KEY in known else {}
        self.inputs = tuple(map(_name, self._request.model_inputs))
        self.outputs = tuple(map(_name, self._request.model_outputs))

    def run(self, tensors: Tensors) -> Tensors:
        """Named inputs, what is not for the graph is left out -> named outputs, on the CPU."""
        given = {name: tensors[name].numpy(force=True) for name in self.inputs}
        found = self._request.infer(given)
        return {name: torch.tensor(found[index]) for index, name in enumerate(self.outputs)}


def read_graph(source: Path | bytes) -> openvino.Model:
    """A file, or an ONNX file's content, as OpenVINO's graph."""
    return _core().read_model(source if isinstance(source, bytes) else str(source))


@cache
def _core() -> openvino.Core:
    """One for the process, never let go.

    A core's CPU plugin sets the thread's stack for signals, and sets the one before again when it
    goes. Cores that do not go in the reverse order leave a stack that is freed, and the next
    signal with a Python handler (a loader's SIGCHLD, Ctrl-C) ends the process.
    """
    return openvino.Core()


def _name(port: Any) -> str:
    """The name that a part gave; what OpenVINO folds together has several."""
    names: set[str] = port.get_names()
    return next(name for name in sorted(names) if name.removeprefix(NEXT) in NAMES)
