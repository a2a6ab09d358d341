"""The command line of `dyfn-app`."""

from __future__ import annotations

import argparse

from dyfn_core.argument_types import at_least_one
from dyfn_core.cli.arguments import add_device, add_model, add_threads, command_parser

PORT = 7860
FRAMES = 300
EPILOG = (
    "Everybody who reaches HOST:PORT can use the page; it is this machine alone unless --host says "
    "otherwise. Ctrl-C ends it. Exit code: 0, or 2 when the page cannot be served."
)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = command_parser(
        "dyfn-app", "Serve a page where a video is dropped and its depth looked at.", EPILOG
    )
    made.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: %(default)s)"
    )
    made.add_argument(
        "--port",
        type=at_least_one,
        default=PORT,
        metavar="N",
        help="port to listen on (default: %(default)s)",
    )
    made.add_argument(
        "--most-frames",
        type=at_least_one,
        default=FRAMES,
        metavar="N",
        help="most frames of a video that are worked on (default: %(default)s)",
    )
    add_model(made)
    add_device(made)
    add_threads(made)
    return made
