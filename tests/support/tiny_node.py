"""stream_depth with the tiny model (or "pinhole"), as a process of its own."""

from __future__ import annotations

import ctypes
import signal
import sys
from typing import TYPE_CHECKING

from dyfn_ros.node import outputs
from dyfn_ros.node.main import main

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel


def load(name: str, device: str) -> GeometryModel:
    from tests.support.pinhole import PinholeModel
    from tests.support.tiny_model import load_tiny

    return PinholeModel().eval() if name == "pinhole" else load_tiny(name, device)


def report(name: str) -> None:
    """Print each call of a message builder, so that a test sees what was built for nobody."""
    build = getattr(outputs, name)

    def reported(*args: object) -> object:
        print(name, flush=True)
        return build(*args)

    setattr(outputs, name, reported)


def die_with_parent() -> None:
    """Tests that are killed must not leave a node in a domain that others take for empty."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


if __name__ == "__main__":
    die_with_parent()
    for builder in ("depth_message", "cloud_message", "colour_message", "compressed_message"):
        report(builder)
    sys.exit(main(load=load))
