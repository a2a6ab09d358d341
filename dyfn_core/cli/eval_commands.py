"""What the sub-commands of dyfn-eval do: score a model or files, rebuild scenes, study a latent."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from dyfn_core.cli import reconstruct, study
from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.long_sequence import (
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
from dyfn_core.evaluation.choices import LENGTHS
from dyfn_core.evaluation.report.html import text_table
from dyfn_core.models.checkpoints import load_model
from dyfn_core.scoring.protocols import ALL_PIXELS

COMPLETE, UNUSABLE, PARTIAL = 0, 2, 3
ORIGINAL_RATE = 1  # stride of the paper's long sequences, which are consecutive frames


def execute(options: argparse.Namespace) -> int:
    """Do what the parser of `cli.eval` has read; returns the exit status."""
    try:
        return COMMANDS[options.run](options)
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
        load_model(options.model, options.device, options.backend),
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


def _open(
    options: argparse.Namespace, frames: int | None = None, stride: int | None = None
) -> Opened:
    """The benchmark with what the command line overrides.

    frames: the most of a sequence; None: by --max-frames or the benchmark. stride: where --stride
    is not given; None: the benchmark's.
    """
    known = benchmark(options.benchmark)
    settings = default_settings(known, find_layout(known, options.data, options.layout))
    crop = None if options.crop is None else tuple(options.crop)
    given: dict[str, Any] = {
        "first": options.start,
        "stride": stride if options.stride is None else options.stride,
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
    opened = _open(options, max(lengths), ORIGINAL_RATE)
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


COMMANDS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    "list": _list,
    "score": _evaluate,
    "long": _long,
    "reconstruct": reconstruct.run,
    "study": study.run,
}
