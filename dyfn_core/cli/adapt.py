"""dyfn-train adapt: a model learns from its user's recordings with odometry, without true depth."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from dyfn_core.adaptation.config import AdaptConfig
from dyfn_core.adaptation.run import AdaptResult, Compared, adapt
from dyfn_core.evaluation.report.html import Cell, Table, text_table
from dyfn_core.evaluation.report.tables import write_tables
from dyfn_core.training.config import override, settings_of

NOT_BETTER = 1
HEADER = (
    *("recording", "part", "frames", "truth", "image AbsRel before", "adapted"),
    *("video AbsRel before", "adapted"),
)
# Options that are settings of AdaptConfig.
SETTINGS = ("decoder", "rate", "hold_back", "test", "steps", "seed")


def run(options: argparse.Namespace) -> int:
    """Adapt, print the table; returns the exit status. Raises as adaptation.run.adapt does."""
    values: dict[str, Any] = {"recordings": options.recordings, "base": options.model}
    given = ((name, getattr(options, name)) for name in SETTINGS)
    values |= {name: value for name, value in given if value is not None}
    for text in options.set:
        override(values, text)
    config = settings_of(values, AdaptConfig, Path("dyfn-train adapt"))
    folder = options.run or options.out.with_suffix(".run")
    result = adapt(config, options.out, folder, options.resume)
    return 0 if result is None else _tell(result, config, options.out, folder)


def _tell(result: AdaptResult, config: AdaptConfig, out: Path, folder: Path) -> int:
    table = comparison_table(result.rows)
    write_tables(folder, "table", table, f"{config.base} before and after")
    for text, count in result.problems.items():
        print(f"dyfn-train: not used: {count} x {text}", file=sys.stderr)
    print(text_table(table))
    change = f"{result.before:.4f} to {result.after:.4f}"
    if result.better:
        print(f"held-back points, one alignment: AbsRel {change} in {result.steps} steps: {out}")
        print("which is a --model for dyfn-replay, dyfn-eval and the node")
        return 0
    print(
        f"dyfn-train: no model was written: on the held-back points {config.base} is as good or "
        f"better (AbsRel {change}, {result.steps} steps)",
        file=sys.stderr,
    )
    return NOT_BETTER


def comparison_table(rows: list[Compared]) -> Table:
    """A row for each part and truth: both models under the image and video protocols."""
    cells: list[list[Cell]] = []
    for row in rows:
        name, before, after = Path(row.recording).name, row.before, row.after
        shared: list[Cell] = [name, row.part, row.frames]
        image = (before.points_image, after.points_image)
        video = (before.points_video, after.points_video)
        cells.append([*shared, "points", *image, *video])
        if before.truth is not None and after.truth is not None:
            sensor = (before.truth, after.truth)
            pairs = [score.image_abs_rel for score in sensor]
            pairs += [score.video_abs_rel for score in sensor]
            cells.append([*shared, "depth sensor", *pairs])
    return Table(HEADER, cells)
