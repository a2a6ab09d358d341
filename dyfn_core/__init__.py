"""Streaming monocular geometry: frames of one camera in, point maps that keep one scale out.

Models: `load_model`, `save_model`; `DyFNModel` with `ModelFacts`, for folders with a model card and
the Hugging Face Hub. One camera over time: `DepthStream` (geometry up to scale), and
`StreamSession` with `StreamOptions`, which adds what the ROS 2 node does: scene cuts, metric scale
from a `PointReference`, `DepthReference` or `ConeReference`, saved state. Several cameras in one
batch: `push_together`. Values: `Frame` goes in, `Prediction` comes out, `StreamState` is DyFN's
memory in between.

Example:
    >>> import numpy as np
    >>> from dyfn_core import DepthStream, load_model
    >>> stream = DepthStream(load_model("dyfn-mini"), num_tokens=24)
    >>> prediction = stream.push(np.full((48, 64, 3), 128, np.uint8), stamp=0.0)
    >>> prediction.depth.shape, prediction.camera_matrix.shape
    (torch.Size([48, 64]), (3, 3))

No ROS dependency; the package dyfn_ros has the ROS 2 node and the recordings.
"""

from typing import TYPE_CHECKING, Any

# Read by type checkers and IDEs only: see __getattr__.
if TYPE_CHECKING:
    from dyfn_core.metric.references import ConeReference as ConeReference
    from dyfn_core.metric.references import DepthReference as DepthReference
    from dyfn_core.metric.references import PointReference as PointReference
    from dyfn_core.models import CheckpointError as CheckpointError
    from dyfn_core.models import load_model as load_model
    from dyfn_core.models import save_model as save_model
    from dyfn_core.models.model_card import ModelFacts as ModelFacts
    from dyfn_core.models.pretrained import DyFNModel as DyFNModel
    from dyfn_core.prediction import Frame as Frame
    from dyfn_core.prediction import Prediction as Prediction
    from dyfn_core.prediction import StreamState as StreamState
    from dyfn_core.stream.depth_stream import DepthStream as DepthStream
    from dyfn_core.stream.depth_stream import push_together as push_together
    from dyfn_core.stream.options import StreamOptions as StreamOptions
    from dyfn_core.stream.saving import StateError as StateError
    from dyfn_core.stream.session import StreamSession as StreamSession

    __version__: str

_HOMES = {
    "CheckpointError": "dyfn_core.models",
    "ConeReference": "dyfn_core.metric.references",
    "DepthReference": "dyfn_core.metric.references",
    "DepthStream": "dyfn_core.stream.depth_stream",
    "DyFNModel": "dyfn_core.models.pretrained",
    "Frame": "dyfn_core.prediction",
    "ModelFacts": "dyfn_core.models.model_card",
    "PointReference": "dyfn_core.metric.references",
    "Prediction": "dyfn_core.prediction",
    "StateError": "dyfn_core.stream.saving",
    "StreamOptions": "dyfn_core.stream.options",
    "StreamSession": "dyfn_core.stream.session",
    "StreamState": "dyfn_core.prediction",
    "load_model": "dyfn_core.models",
    "push_together": "dyfn_core.stream.depth_stream",
    "save_model": "dyfn_core.models",
}

__all__ = [
    "CheckpointError",
    "ConeReference",
    "DepthReference",
    "DepthStream",
    "DyFNModel",
    "Frame",
    "ModelFacts",
    "PointReference",
    "Prediction",
    "StateError",
    "StreamOptions",
    "StreamSession",
    "StreamState",
    "__version__",
    "load_model",
    "push_together",
    "save_model",
]


def __getattr__(name: str) -> Any:
    # On first use: the models import torch, two seconds that `dyfn-train --help`, a recording
    # worker or dyfn_core.files must not pay.
    if name == "__version__":
        value: Any = _version()
    elif name in _HOMES:
        from importlib import import_module

        value = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("dyfn_ros")  # the distribution that holds all three packages
    except PackageNotFoundError:  # a source tree on the path, not installed
        return "0+unknown"
