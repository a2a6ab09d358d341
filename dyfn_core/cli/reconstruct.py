"""dyfn-eval reconstruct: poses and a fused cloud, with and without DyFN and from true depth."""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Mapping
from pathlib import Path

from tqdm import tqdm

from dyfn_core.cli.chosen_data import open_sequence, places
from dyfn_core.cli.fuse_aligned import run_fusion
from dyfn_core.evaluation.choices import TRUE
from dyfn_core.evaluation.reconstruction.cloud_error import write_ply
from dyfn_core.evaluation.reconstruction.matching import build_matcher
from dyfn_core.evaluation.reconstruction.poses import ReconstructionOptions
from dyfn_core.evaluation.reconstruction.runs import (
    TABLE_NOTE,
    RunResult,
    SequenceRuns,
    aligned_cloud,
    draw_run,
    judge,
    reconstruct_sequence,
    reconstruction_table,
)
from dyfn_core.evaluation.report.html import (
    Part,
    ReportPicture,
    Section,
    Table,
    Text,
    text_table,
    write_report,
)
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.models.checkpoints import load_model

COMPLETE, UNUSABLE, PARTIAL = 0, 2, 3


def run(options: argparse.Namespace) -> int:
    """-> exit status. Raises ValueError, DataError or OSError for what is unusable."""
    if options.fuse_aligned:
        if not options.with_model:
            raise ValueError(
                "--fuse-aligned aligns a model's depth: it does not go with --no-model"
            )
        return run_fusion(options, load_model(options.model, options.device, options.backend))
    settings = ReconstructionOptions(
        offsets=tuple(options.offsets),
        threshold=options.threshold,
        with_scale=options.with_scale,
        voxel=options.voxel,
        seed=options.seed,
    )
    matcher = build_matcher(options.matcher)
    sequence = open_sequence(options)
    chosen = places(options, len(sequence))
    model = None
    if options.with_model:
        model = load_model(options.model, options.device, options.backend)
    found = reconstruct_sequence(
        sequence,
        tqdm(chosen, unit="frame", file=sys.stderr),
        matcher,
        model,
        settings,
        true_depth=options.true_depth,
        num_tokens=options.num_tokens,
        true_poses=options.poses == TRUE,
    )
    results = {name: judge(found, name, options.tolerance) for name in found.runs}
    options.out.mkdir(parents=True, exist_ok=True)
    _write(options, found, results, sequence.name)
    print(text_table(reconstruction_table(results)))
    for name, result in results.items():
        for text in _told(result):
            print(f"{name}: {text}")
    for text, count in found.losses.items():
        print(f"dyfn-eval: loss: {text} ({count} times)", file=sys.stderr)
    return PARTIAL if found.losses else COMPLETE


def _told(result: RunResult) -> list[str]:
    problems = [f"{count} frames without a pose: {why}" for why, count in result.problems.items()]
    return [*problems, *result.notes]


def _write(
    options: argparse.Namespace,
    found: SequenceRuns,
    results: Mapping[str, RunResult],
    sequence: str,
) -> None:
    out: Path = options.out
    given = {key: value for key, value in vars(options).items() if key not in ("run", "command")}
    shown = {key: str(v) if isinstance(v, Path) else v for key, v in given.items()}
    runs = {name: result.values() for name, result in results.items()}
    summary = {
        "sequence": sequence,
        "options": shown,
        "runs": runs,
        "losses": dict(found.losses),
    }
    pictures: list[Section] = []
    for name in found.runs:
        stem = name.replace(" ", "_").lower()
        points, colours, metric = aligned_cloud(found, name)
        runs[name]["ply_in_metres"] = metric
        picture = draw_run(found, name)
        (out / f"cloud_{stem}.png").write_bytes(encode_picture(picture))
        if len(points):
            write_ply(out / f"cloud_{stem}.ply", points, colours)
        parts: list[Part] = [ReportPicture(picture, f"cloud, {name}: from above and obliquely")]
        parts += [Text(text, note=True) for text in _told(results[name])]
        pictures.append(Section(f"Fused cloud, {name}", parts))
    _write_frames(out / "frames.csv", found)
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    (out / "reconstruction.json").write_text(text, encoding="utf-8")
    scores = Section("Scores", [reconstruction_table(results), Text(TABLE_NOTE, note=True)])
    facts = Table(("", ""), [[key, _shown(value)] for key, value in shown.items()])
    title = f"Reconstruction of {Path(sequence).name}"
    write_report(out / "report.html", title, [scores, *pictures, Section("What was run", [facts])])


def _shown(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)


def _write_frames(path: Path, found: SequenceRuns) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("run", "frame", "posed", "pairs", "inliers", "partners", "problem"))
        for name, run_ in found.runs.items():
            for index, frame in enumerate(run_.frames):
                used = " ".join(map(str, frame.partners))
                posed = int(frame.pose is not None)
                row = (name, index, posed, frame.pairs, frame.inliers, used, frame.problem or "")
                writer.writerow(row)
