"""`dyfn-record`: the command."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from dyfn_ros.record.options import parse
from dyfn_ros.recordings.errors import RecordingError

ALL, UNUSABLE, PARTIAL = 0, 2, 3  # exit codes, as dyfn-replay's


def main(arguments: Sequence[str] | None = None) -> int:
    """-> exit code."""
    options = parse(arguments)  # ends the process for --help and wrong options
    from dyfn_ros.record.make import make_recording  # seconds of torch: only now

    try:
        count, left_out = make_recording(options)
    except (RecordingError, OSError) as error:
        print(f"dyfn-record: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-record: interrupted, nothing was written", file=sys.stderr)
        return 130
    for reason, times in left_out.items():
        print(f"dyfn-record: {reason}{f' ({times} times)' if times > 1 else ''}", file=sys.stderr)
    print(f"{count} frames in {options.out}")
    return PARTIAL if left_out else ALL


if __name__ == "__main__":
    sys.exit(main())
