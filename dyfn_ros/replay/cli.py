"""`dyfn-replay`: the command."""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dyfn_ros.replay.options import parse

if TYPE_CHECKING:
    from dyfn_ros.replay.run import ModelLoader


def main(arguments: Sequence[str] | None = None, loader: ModelLoader | None = None) -> int:
    """Replay what the command line asks for.

    Args:
        arguments: Without the program's name; None: those of the process.
        loader: Gives the models; None: load_model.

    Returns:
        The exit code.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    command = parse(arguments)  # ends the process for --help and wrong options
    from dyfn_ros.replay.command import execute  # seconds of torch: only now

    return execute(command, loader)


if __name__ == "__main__":
    sys.exit(main())
