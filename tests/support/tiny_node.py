"""stream_depth with the model tiny, pinhole, "pinhole with DyFN" or endless, as a process."""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
from typing import TYPE_CHECKING

from dyfn_ros.node.end_request import SIGNALS
from dyfn_ros.node.main import main

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel


def load(name: str, device: str) -> GeometryModel:
    if name == "endless":
        print("loading for ever", flush=True)
        threading.Event().wait()
    from tests.support.pinhole import PinholeModel
    from tests.support.tiny_model import load_tiny

    for kind in ("depth", "cloud", "colour", "compressed", "normal"):
        report(f"{kind}_message")
    if name in ("pinhole", "pinhole with DyFN"):
        return PinholeModel(stabilized=name != "pinhole").eval()
    return load_tiny(name, device)


def report(name: str) -> None:
    """Print each call of a message builder, so that a test sees what was built for nobody."""
    from dyfn_ros.node import outputs

    build = getattr(outputs, name)
    if hasattr(build, "reported"):  # by a model that was loaded before
        return

    def reported(*args: object) -> object:
        print(name, flush=True)
        return build(*args)

    reported.reported = True  # type: ignore[attr-defined]
    setattr(outputs, name, reported)


def die_with_parent() -> None:
    """Tests that are killed must not leave a node in a domain that others take for empty."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


if __name__ == "__main__":
    die_with_parent()
    # As EndRequest does, which must be there before the threads that numpy starts.
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    from tests.support.odometry import use_tf_stand_in

    use_tf_stand_in()
    main(load=load)
