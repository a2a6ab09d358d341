"""dyfn-eval: score a model, or any method's files; rebuild scenes; study the latent."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from dyfn_core.argument_types import at_least_one
from dyfn_core.cli import reconstruct, study
from dyfn_core.cli.arguments import Commands, add_strict, command_parser, described
from dyfn_core.cli.eval_arguments import add_benchmark, add_predictions, add_run
from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.long_sequence import (
    LENGTHS,
    length_table,
    long_sequences,
    write_lengths,
)
from dyfn_core.evaluation.benchmarks.model_method import ModelMethod
from dyfn_core.evaluation.benchmarks.pictures import BenchmarkPictures
from dyfn_core.evaluation.benchmarks.predictions import ArrayMethod, Method, PredictionFolder
from dyfn_core.evaluation.benchmarks.registry import (
    BENCHMARKS,
    Benchmark,
    Opened,
    benchmark,
    default_settings,
    find_layout,
    open_benchmark,
)
from dyfn_core.evaluation.benchmarks.report import role, write_benchmark_report
from dyfn_core.evaluation.benchmarks.run import Scoring, evaluate
from dyfn_core.evaluation.benchmarks.table import metres_table, write_json, write_results
from dyfn_core.evaluation.report.html import text_table
from dyfn_core.models.checkpoints import load_model
from dyfn_core.scoring.protocols import ALL_PIXELS

COMPLETE, UNUSABLE, PARTIAL = 0, 2, 3


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    options = parser().parse_args(arguments)
    try:
        command: Callable[[argparse.Namespace], int] = options.run
        return command(options)
    except (DataError, FrameError, OSError, ValueError, ImportError) as error:
        print(f"dyfn-eval: {error}", file=sys.stderr)
        return UNUSABLE
    except KeyboardInterrupt:
        print("dyfn-eval: interrupted; nothing was written", file=sys.stderr)
        return 130


def _list(options: argparse.Namespace) -> int:
    for known in BENCHMARKS.values():
        print(_described(known))
    return COMPLETE


def _described(known: Benchmark) -> str:
    settings = known.settings
    rows, columns = settings.crop
    count = f"{len(known.sequences)} sequences" if known.sequences else "whatever sequences it has"
    frames = "all frames" if settings.frames is None else f"at most {settings.frames} frames"
    every = "" if settings.stride == 1 else f", stride {settings.stride}"
    start = f", from frame {settings.first} (counted from 0)" if settings.first else ""
    cap = "no cap" if math.isinf(settings.depth_max) else f"cap {settings.depth_max:g} m"
    crop = (
        f"; crop {rows} px above and below, {columns} left and right" if any(settings.crop) else ""
    )
    videos = f"; or {known.video_set}/*_rgb_left.mp4" if known.video_set else ""
    return (
        f"{known.name}: {known.title}\n  {count}; {frames}{every}{start}; "
        f"{cap}{crop}\n  {known.expected}{videos}"
    )


def _model(options: argparse.Namespace) -> Method:
    return ModelMethod(
        options.name or Path(options.model).stem,
        load_model(options.model, options.device),
        stabilize=options.stabilize,
        controls=options.controls,
        num_tokens=options.num_tokens,
        known_camera=options.known_camera,
        metres_from=tuple(dict.fromkeys(options.metres_from)),
    )


def _files(options: argparse.Namespace) -> Method:
    folder = PredictionFolder(options.predictions, options.scale, options.key)
    name = options.name or options.predictions.resolve().name
    return ArrayMethod(name, options.quantity, folder.arrays)


def _method(options: argparse.Namespace) -> Method:
    return _model(options) if getattr(options, "model", None) else _files(options)


def _open(options: argparse.Namespace, frames: int | None = None) -> Opened:
    """The benchmark with what the command line overrides."""
    known = benchmark(options.benchmark)
    settings = default_settings(known, find_layout(known, options.data, options.layout))
    crop = None if options.crop is None else tuple(options.crop)
    given: dict[str, Any] = {
        "first": options.start,
        "stride": options.stride,
        "frames": options.max_frames if frames is None else frames,
        "depth_max": options.depth_max,
        "crop": crop,
    }
    settings = replace(settings, **{k: v for k, v in given.items() if v is not None})
    if options.all_frames:
        settings = replace(settings, frames=None)
    opened = open_benchmark(
        options.benchmark,
        options.data,
        settings,
        layout=options.layout,
        sequences=options.sequences,
        allow_missing=options.allow_missing,
    )
    _note(opened.report.summary())
    for name in opened.missing:
        _note(f"missing: {name}")
    return opened


def _scoring(options: argparse.Namespace, temporal: bool) -> Scoring:
    if options.all_pixels:
        return Scoring(options.fit, ALL_PIXELS, ALL_PIXELS, temporal)
    return Scoring(options.fit, temporal=temporal)


def _evaluate(options: argparse.Namespace) -> int:
    opened = _open(options)
    method = _method(options)
    names = [one.name for one in opened.sequences]
    shown = [name for name in method.variants if role(name) != "control"]
    pictures = BenchmarkPictures(names, method.quantity, method.variants, shown)
    results = evaluate(
        opened,
        method,
        _scoring(options, options.temporal),
        allow_missing=options.allow_missing,
        note=_note,
        pictures=pictures,
    )
    results = {**_provenance(options), **results}
    table = write_results(results, options.out, _title(opened), options.ablations)
    path = options.out / "report.html"
    write_benchmark_report(path, _title(opened), table, results, pictures, method.seconds)
    tables = [table, metres_table(results)]
    printed = "\n\n".join(text_table(found) for found in tables if found.rows)
    return _finish(printed, results, options)


def _long(options: argparse.Namespace) -> int:
    lengths = options.lengths or LENGTHS
    opened = _open(options, max(lengths))
    results = long_sequences(
        opened,
        _method(options),
        lengths,
        _scoring(options, False),
        allow_missing=options.allow_missing,
        note=_note,
    )
    options.out.mkdir(parents=True, exist_ok=True)
    results = {**_provenance(options), **results}
    write_json(options.out / "results.json", results)
    write_lengths(results, options.out, _title(opened))
    return _finish(text_table(length_table(results)), results, options)


def _provenance(options: argparse.Namespace) -> dict[str, Any]:
    """What was asked for, as JSON can hold it."""
    plain = {k: v for k, v in vars(options).items() if k != "run"}
    return {"options": {k: str(v) if isinstance(v, Path) else v for k, v in plain.items()}}


def _title(opened: Opened) -> str:
    count = len(opened.sequences)
    return f"{opened.benchmark.title}, {count} sequence{'s' if count != 1 else ''}"


def _finish(table: str, results: dict[str, Any], options: argparse.Namespace) -> int:
    print(table)
    print(f"written to {options.out}")
    for name in results["missing"]:
        _note(f"not scored: {name}")
    doubted = options.strict and results["warnings"]
    return PARTIAL if results["missing"] or doubted else COMPLETE


def _note(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    parser = command_parser(
        "dyfn-eval",
        "Score a model, or any method's files; rebuild scenes; study the latent.",
        "Exit status: 0 everything was scored; 3 part of the benchmark was missing or could not "
        "be scored, and --allow-missing let the rest go on, or with --strict the scores are hard "
        "to believe; 2 nothing could be scored, or bad "
        "arguments.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_list(commands)
    _add_scored(commands)
    _add_long(commands)
    reconstruct.add_parser(commands)
    study.add_parser(commands)
    return parser


def _add_list(commands: Commands) -> None:
    text = "print the benchmarks: layout, frames, cap, crop"
    commands.add_parser("list", help=text, description=described(text)).set_defaults(run=_list)


def _add_scored(commands: Commands) -> None:
    text = "score a model, with its controls"
    command = commands.add_parser("run", help=text, description=described(text))
    add_benchmark(command)
    add_run(command)
    _add_tables(command)
    text = "score predictions from files"
    command = commands.add_parser("score", help=text, description=described(text))
    add_benchmark(command)
    add_predictions(command)
    _add_tables(command)


def _add_long(commands: Commands) -> None:
    text = "error against length, the alignment solved again at every length"
    command = commands.add_parser("long", help=text, description=described(text))
    add_benchmark(command)
    source = command.add_argument_group("what is scored (one of --model and --predictions)")
    either = source.add_mutually_exclusive_group(required=True)
    add_run(command, either)
    add_predictions(command, either)
    command.add_argument(
        "--lengths",
        type=at_least_one,
        nargs="+",
        metavar="N",
        help=f"frames (default: {' '.join(map(str, LENGTHS))})",
    )
    add_strict(command.add_argument_group("checks"))
    command.set_defaults(run=_long)


def _add_tables(command: argparse.ArgumentParser) -> None:
    group = command.add_argument_group("tables")
    group.add_argument(
        "--temporal",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="also compute TAE and flicker (default: %(default)s)",
    )
    add_strict(group)
    group.add_argument("--ablations", action="store_true", help="also print the paper's ablations")
    command.set_defaults(run=_evaluate)


if __name__ == "__main__":
    sys.exit(main())
