"""dyfn-export: a model's pure step as a file for another library."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dyfn_core.argument_types import image_size
from dyfn_core.cli.arguments import add_num_tokens, add_stabilize, command_parser
from dyfn_core.files import OutputError

if TYPE_CHECKING:
    from dyfn_core.models.export.step_file import StepInfo

COMPLETE, UNUSABLE = 0, 2
FORMATS = ("onnx", "openvino", "tensorrt")
SIZE = (480, 640)


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
        "--format",
        choices=FORMATS,
        default="onnx",
        help="of the file; openvino: FILE is NAME.xml, the weights are beside it in NAME.bin; "
        "tensorrt: an engine for the GPU of this machine, what it is says FILE.json (default: "
        "%(default)s)",
    )
    made.add_argument(
        "--size",
        type=image_size,
        metavar="WIDTHxHEIGHT",
        help="of the camera's images; a file is for one size (default: 640x480, or that of the "
        "recording)",
    )
    made.add_argument(
        "--int8",
        action="store_true",
        help="format onnx: layers compute in 8 bits where that loses little: less than 0.5 points "
        "of delta1 and 1%% of median depth on the last third of the recording's frames; else "
        "nothing is written",
    )
    made.add_argument(
        "--calibrate",
        metavar="[KIND=]PATH",
        help="RGB-D folder, recording or data set with depth, for --int8",
    )
    add_num_tokens(made)
    add_stabilize(made)
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """-> exit status."""
    made = parser()
    options = made.parse_args(arguments)
    if options.int8 != (options.calibrate is not None):
        made.error("--int8 and --calibrate RECORDING go together")
    if options.int8 and options.format != "onnx":
        made.error(f"--int8 is for --format onnx, not {options.format}")
    try:
        info = _int8(options) if options.int8 else _float(options)
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


def _float(options: argparse.Namespace) -> StepInfo:
    from dyfn_core.models.checkpoints import load_model

    write = _writer(options.format)
    model, size = load_model(options.model), options.size or SIZE
    return write(model, options.out, size, options.num_tokens, options.stabilize)


def _writer(kind: str) -> Callable[..., StepInfo]:
    if kind == "openvino":
        from dyfn_core.models.export.openvino_file import write_openvino_step

        return write_openvino_step
    if kind == "tensorrt":
        from dyfn_core.models.export.tensorrt_file import write_tensorrt_step

        return write_tensorrt_step
    from dyfn_core.models.export.step_file import write_step

    return write_step


def _int8(options: argparse.Namespace) -> StepInfo:
    from dyfn_core.cli.chosen_data import data_spec
    from dyfn_core.data.pool import open_pool
    from dyfn_core.evaluation.int8 import write_int8_step
    from dyfn_core.models.checkpoints import load_model

    sequence = open_pool([data_spec(options.calibrate)], "train").sequences[0]
    height, width = sequence.read(0).image.shape[:2]
    if options.size not in (None, (height, width)):
        raise ValueError(
            f"--size is for images of {options.size[1]}x{options.size[0]}, those of "
            f"{options.calibrate} are {width}x{height}"
        )
    chosen = options.num_tokens, options.stabilize
    info, loss = write_int8_step(load_model(options.model), options.out, sequence, *chosen)
    print(f"8 bits: {loss}")
    return info


if __name__ == "__main__":
    sys.exit(main())
