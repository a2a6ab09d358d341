"""The pure step of a model as OpenVINO's own pair of files."""

from __future__ import annotations

import tempfile
from pathlib import Path

import openvino

from dyfn_core.files import cannot_write
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.export.openvino_graph import read_graph
from dyfn_core.models.export.step_file import KEY, Size, StepInfo, step_graph, text_of
from dyfn_core.models.formats import CheckpointError

XML, WEIGHTS = ".xml", ".bin"


def write_openvino_step(
    model: GeometryModel,
    path: Path,
    image_size: Size = (480, 640),
    num_tokens: int | None = None,
    stabilize: bool = True,
) -> StepInfo:
    """Write the pure step of a model as OpenVINO IR: a graph, .xml, and its weights, .bin.

    Weights are float32. The metadata are the entry KEY of the graph's rt_info.

    Args:
        model: See step_graph.
        path: The graph, which is replaced with its weights if it exists; ends with .xml.
        image_size: See step_graph.
        num_tokens: See step_graph.
        stabilize: See step_graph.

    Returns:
        What the file says of itself.

    Raises:
        ValueError: The name ends otherwise.
        CheckpointError: The model has something that ONNX or OpenVINO cannot say.
        OutputError: The files cannot be written.
    """
    if path.suffix != XML:
        raise ValueError(f"{path}: a file for OpenVINO has a name that ends with {XML}")
    step, info = step_graph(model, image_size, num_tokens, stabilize)
    try:
        graph = read_graph(step.SerializeToString())
    except RuntimeError as error:
        raise CheckpointError(f"the step cannot be read by OpenVINO: {error}") from error
    graph.set_rt_info(text_of(info), [KEY])
    try:
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            made = Path(folder) / f"step{XML}"
            openvino.save_model(graph, made, compress_to_fp16=False)
            # A graph is never beside another one's weights, wherever this ends.
            path.unlink(missing_ok=True)
            made.with_suffix(WEIGHTS).replace(path.with_suffix(WEIGHTS))
            made.replace(path)
    except (OSError, RuntimeError) as error:
        cause = error if isinstance(error, OSError) else OSError(str(error))
        raise cannot_write(path, cause) from error
    return info
