"""stream_depth with the tiny model, as a process of its own."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from dyfn_ros import messages
from dyfn_ros.stream_depth import main

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel


def load(name: str, device: str) -> GeometryModel:
    from tiny_model import load_tiny

    return load_tiny(name, device)


def report(name: str) -> None:
    """Print each call of a message builder, so that a test sees what was built for nobody."""
    build = getattr(messages, name)

    def reported(*args: object) -> object:
        print(name, flush=True)
        return build(*args)

    setattr(messages, name, reported)


if __name__ == "__main__":
    for builder in ("depth_message", "cloud_message", "colour_message", "compressed_message"):
        report(builder)
    sys.exit(main(load=load))
