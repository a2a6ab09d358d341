"""dyfn-worlds: renders training worlds to disk."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NoReturn

from dyfn_worlds.camera.choices import PACES, PLACEMENTS, SAMPLES, USUAL

UNUSABLE, INTERRUPTED = 2, 130


class _Parser(argparse.ArgumentParser):
    """As dyfn_core.cli.arguments has it, of which this package knows nothing."""

    def error(self, message: str) -> NoReturn:
        self.exit(UNUSABLE, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _size(text: str) -> tuple[int, int]:
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise argparse.ArgumentTypeError(f"expected HEIGHTxWIDTH such as 240x320, got {text!r}")
    return int(height), int(width)


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number of 0 or more, got {text!r}")
    return int(text)


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a finite number above 0, got {text!r}")
    return value


def _version() -> str:
    try:
        return version("dyfn_ros")  # the distribution that holds this package
    except PackageNotFoundError:
        return "0+unknown"


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = _Parser(
        prog="dyfn-worlds",
        description="Render training worlds with exact depth, intrinsics and poses.",
        epilog="Exit code: 0 all shards are written, 2 bad arguments or unusable art.",
    )
    parser.add_argument(
        "--version",
        action="version",
        version=f"dyfn-worlds {_version()}",
        help="print the version and exit",
    )
    add = parser.add_argument_group("worlds").add_argument
    add("--assets", type=Path, required=True, metavar="DIR", help="folder that holds the art")
    add(
        "--worlds",
        choices=("maps", "rooms"),
        default="maps",
        help="maps: Quake levels; rooms: furnished rooms (default: maps)",
    )
    add(
        "--placement",
        choices=PLACEMENTS,
        default=USUAL,
        help="where the camera of a view stands: close before a thing, steeply above it, low over "
        f"the floor, or high above (default: {USUAL})",
    )
    add("--pace", choices=tuple(PACES), help="how the camera of a clip moves (default: drawn)")
    add("--seed", type=_count, default=0, metavar="N", help="seed of the first shard (default: 0)")
    add = parser.add_argument_group("output").add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder of shards to add to")
    add("--shards", type=_count, default=100, metavar="N", help="shards to render (default: 100)")
    add(
        "--views",
        type=_count,
        default=24,
        metavar="N",
        help="independent views per shard (default: 24)",
    )
    add(
        "--clip-frames",
        type=_count,
        default=0,
        metavar="N",
        help="render clips of N frames instead of views (default: 0, views)",
    )
    add(
        "--clip-fps",
        type=_rate,
        default=5.0,
        metavar="X",
        help="frames per second of a clip (default: 5)",
    )
    add(
        "--size",
        type=_size,
        default=(240, 320),
        metavar="HEIGHTxWIDTH",
        help="image size in pixels (default: 240x320)",
    )
    add(
        "--samples",
        type=int,
        choices=range(1, SAMPLES + 1),
        default=SAMPLES,
        help="draws within each pixel of a sharp picture, and that share of the sub-frames of a "
        f"blurred one; fewer are faster and less smooth (default: {SAMPLES})",
    )
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """-> exit code."""
    reader = parser()
    options = reader.parse_args(argv)
    if options.pace and not options.clip_frames:
        reader.error("--pace is that of clips, and --clip-frames is 0")
    if options.placement != USUAL and options.clip_frames:
        reader.error("--placement is that of views, and --clip-frames asks for clips")
    try:
        from dyfn_worlds.render_shards import execute  # the renderer's libraries: only now

        execute(options)
    except ModuleNotFoundError:
        raise  # the entry point names the extra
    except (OSError, ValueError, ImportError) as error:
        print(f"dyfn-worlds: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-worlds: interrupted; the finished shards stay", file=sys.stderr)
        return INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
