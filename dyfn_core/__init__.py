"""Streaming monocular geometry that keeps its scale (no ROS in here)."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dyfn_core.models import load_model as load_model
    from dyfn_core.models import save_model as save_model
    from dyfn_core.prediction import Frame as Frame
    from dyfn_core.prediction import Prediction as Prediction
    from dyfn_core.prediction import StreamState as StreamState
    from dyfn_core.stream.depth_stream import DepthStream as DepthStream

_HOMES = {
    "load_model": "dyfn_core.models",
    "save_model": "dyfn_core.models",
    "Frame": "dyfn_core.prediction",
    "Prediction": "dyfn_core.prediction",
    "StreamState": "dyfn_core.prediction",
    "DepthStream": "dyfn_core.stream.depth_stream",
}

__all__ = ["DepthStream", "Frame", "Prediction", "StreamState", "load_model", "save_model"]


def __getattr__(name: str) -> Any:
    # On first use: importing a small part of the package must not cost the seconds of the models.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
