"""A graph of named tensors in onnxruntime."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import onnxruntime
import torch

from dyfn_core.models.export.cache import cached
from dyfn_core.models.export.folder import export_folder
from dyfn_core.models.export.onnx_graph import exported
from dyfn_core.models.export.parts import Part, Tensors
from dyfn_core.models.export.step_file import StepInfo, info_of
from dyfn_core.models.formats import CheckpointError

if TYPE_CHECKING:
    from dyfn_core.models.export.openvino_graph import OpenVinoGraph

CPU = ("CPUExecutionProvider",)
CUDA = ("CUDAExecutionProvider", *CPU)
TENSORRT = ("TensorrtExecutionProvider", *CUDA)


def offered() -> list[str]:
    """The providers that this onnxruntime was built with."""
    return list(onnxruntime.get_available_providers())


def graph_of(part: Part, made_of: dict[str, Any]) -> Path | bytes:
    """A part as an ONNX graph, from the cache of exports if it is there; see cache.cached."""
    return cached(made_of, lambda: exported(part))


class OnnxSession:
    """An ONNX graph, ready to run.

    Attributes:
        inputs: Names of what goes in.
        outputs: Names of what comes out.
        metadata: What the file says of itself.
    """

    def __init__(
        self, source: str | Path | bytes, threads: int = 0, providers: Sequence[str] = CPU
    ) -> None:
        """Load a graph.

        Args:
            source: A file, or a file's content.
            threads: CPU threads; 0 takes as many as torch computes with now.
            providers: What runs it, the best first.

        Raises:
            CheckpointError: It cannot be read, or has something that onnxruntime does not know.
        """
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or torch.get_num_threads()
        options.inter_op_num_threads = 1
        # Threads that wait by spinning take the processor from whatever else runs there.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3  # errors; warnings are of shapes that were folded
        graph = source if isinstance(source, bytes) else str(source)
        try:
            self._session = onnxruntime.InferenceSession(
                graph, options, providers=[_with_options(name) for name in providers]
            )
        except Exception as error:  # of many kinds, none of them public
            name = "an ONNX graph" if isinstance(source, bytes) else source
            raise CheckpointError(f"{name} cannot be loaded by onnxruntime: {error}") from error
        self.inputs = tuple(value.name for value in self._session.get_inputs())
        self.outputs = tuple(value.name for value in self._session.get_outputs())
        self.metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map

    def run(self, tensors: Tensors) -> Tensors:
        """Named inputs, what is not for the graph is left out -> named outputs, on the CPU."""
        given = {name: tensors[name].numpy(force=True) for name in self.inputs}
        found = self._session.run(self.outputs, given)
        return {
            name: torch.from_numpy(value) for name, value in zip(self.outputs, found, strict=True)
        }


def _with_options(provider: str) -> str | tuple[str, dict[str, Any]]:
    if provider != TENSORRT[0]:
        return provider
    folder = export_folder() / "tensorrt"
    folder.mkdir(parents=True, exist_ok=True)
    return provider, {"trt_engine_cache_enable": True, "trt_engine_cache_path": str(folder)}


def load_step(path: str | Path, threads: int = 0) -> tuple[StepInfo, OnnxSession | OpenVinoGraph]:
    """A file of dyfn-export, ready to run.

    Args:
        path: The file; one that ends with .xml runs in OpenVINO, others in onnxruntime.
        threads: See OnnxSession.

    Returns:
        What the file says of itself, and the step: `image` and the state in, see StepInfo.

    Raises:
        FileNotFoundError: No such file.
        CheckpointError: Not a file of dyfn-export, or of another format.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"no such file: {path}")
    session: OnnxSession | OpenVinoGraph
    if Path(path).suffix == ".xml":
        from dyfn_core.models.export.openvino_graph import OpenVinoGraph

        session = OpenVinoGraph(Path(path), threads)
    else:
        session = OnnxSession(path, threads)
    return info_of(session.metadata, str(path)), session
