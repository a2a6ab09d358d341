"""`dyfn-demo`: the command."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Sequence

from dyfn_core.extras import missing
from dyfn_ros.demo.node_process import NODE_COMMAND, LiveError
from dyfn_ros.demo.options import parse
from dyfn_ros.recordings.errors import RecordingError

OK, FAILED, UNUSABLE = 0, 1, 2


def main(arguments: Sequence[str] | None = None, command: Sequence[str] = NODE_COMMAND) -> int:
    """-> exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    options = parse(arguments)  # ends the process for --help and wrong options
    from dyfn_ros.demo.run import demo  # seconds of torch: only now

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the node too
    try:
        demo(options, command)
    except RecordingError as error:
        print(f"dyfn-demo: {error}", file=sys.stderr)
        return UNUSABLE
    except ImportError as error:
        print(f"dyfn-demo: {missing(error)}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("dyfn-demo: interrupted", file=sys.stderr)
        return 130
    except LiveError as error:
        print(f"dyfn-demo: {error}", file=sys.stderr)
        return FAILED
    finally:
        signal.signal(signal.SIGTERM, before)
    return OK


if __name__ == "__main__":
    sys.exit(main())
