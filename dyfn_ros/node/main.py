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
    end = EndRequest()
    prepare_environment()
    try:
        # Imports that take seconds, here where a signal already has its meaning.
        from dyfn_ros.node.process import run

        code = run(sys.argv if args is None else list(args), load, end)
    except ModuleNotFoundError as error:
        print(f"stream_depth: {missing(error)}", file=sys.stderr)
        end.leave(1)
    except Exception:
        traceback.print_exc()
        end.leave(1)
    sys.exit(code)  # the middleware frees its shared memory as the interpreter ends


if __name__ == "__main__":
    main()
