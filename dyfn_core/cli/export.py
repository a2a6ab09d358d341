"""dyfn-export: a model's pure step as an ONNX file."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from dyfn_core.argument_types import image_size
from dyfn_core.cli.arguments import add_num_tokens, add_stabilize, command_parser
from dyfn_core.files import OutputError

COMPLETE, UNUSABLE = 0, 2
FORMATS = ("onnx",)


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    made = command_parser(
        "dyfn-export",
        "Write a model's step (image, state) -> (points, mask, state) to a file that says what it "
        "is: sizes, preparation of the image, state, checksum of the weights.",
        "Exit status: 0 done, 2 unusable.",
    )
    made.add_argument("model", help="bundled name (dyfn-mini), checkpoint file, or Hub id")
    made.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="the file, replaced if it exists"
    )
    made.add_argument(
        "--format", choices=FORMATS, default="onnx", help="of the file (default: %(default)s)"
    )
    made.add_argument(
        "--size",
        type=image_size,
        default=(480, 640),
        metavar="WIDTHxHEIGHT",
        help="of the camera's images; a file is for one size (default: 640x480)",
    )
    add_num_tokens(made)
    add_stabilize(made)
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """-> exit status."""
    options = parser().parse_args(arguments)
    from dyfn_core.models.checkpoints import load_model
    from dyfn_core.models.export.step_file import write_step

    try:
        model = load_model(options.model)
        info = write_step(model, options.out, options.size, options.num_tokens, options.stabilize)
    except (FileNotFoundError, OutputError, ValueError) as error:
        print(f"dyfn-export: {error}", file=sys.stderr)
        return UNUSABLE
    (height, width), (rows, columns) = info.image_size, info.prepared_size
    print(
        f"{options.out}: {options.model} {'with' if info.stabilized else 'without'} DyFN for "
        f"images of {width} x {height} pixels, input image 1 x 3 x {rows} x {columns}, weights "
        f"{info.weights[:12]}"
    )
    return COMPLETE


if __name__ == "__main__":
    sys.exit(main())
