"""The command `stream_depth`: the node in a process of its own."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

from dyfn_core.extras import missing
from dyfn_ros.node.end_request import EndRequest
from dyfn_ros.node.environment import prepare_environment

if TYPE_CHECKING:
    from dyfn_ros.node.node import ModelLoader


def main(args: Sequence[str] | None = None, load: ModelLoader | None = None) -> NoReturn:
    """Run the node and end the process: with 0 after SIGINT or SIGTERM, 1 when it cannot run.

    args: the command line; None takes sys.argv. load: (name, device) -> model; None is load_model.
    """
    arguments = sys.argv if args is None else list(args)
    end = EndRequest()
    prepare_environment()
    try:
        _take_own(arguments)
        # Imports that take seconds, here where a signal already has its meaning.
        from dyfn_ros.node.process import run

        code = run(arguments, load, end)
    except ModuleNotFoundError as error:
        print(f"stream_depth: {missing(error)}", file=sys.stderr)
        end.leave(1)
    except Exception:
        traceback.print_exc()
        end.leave(1)
    sys.exit(code)  # the middleware frees its shared memory as the interpreter ends


def _take_own(arguments: Sequence[str]) -> None:
    """--help, and words that nobody knows, end the process here, before torch is imported."""
    from dyfn_ros.node.parameters.usage import usage

    try:
        usage(arguments)
    except RuntimeError as error:  # what rcl does not accept
        print(f"stream_depth: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
