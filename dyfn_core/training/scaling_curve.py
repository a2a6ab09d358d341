"""Images seen against validation error of a run, for model cards: a table and a picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
import yaml

from dyfn_core.training.loop.checkpoint import STATE_FILE
from dyfn_core.training.loop.run_folder import CONFIG_FILE, LOG_FILE, read_log

BOOKKEEPING = ("step", "seconds", "images", "group")


class CurveError(ValueError):
    """A run without the curve that was asked for; the message says what it has."""


def scaling_curve(
    run: Path, metrics: Sequence[str] = (), config: Path | None = None
) -> list[dict[str, float]]:
    """One row for each validation of a run: step, images, and each metric that was logged.

    metrics: names such as "rendered_abs_rel"; all that were logged if none is given. Images are
    those in the log; for logs without them they follow from the batch sizes in config.yaml, the
    checkpoint, or `config`. Raises CurveError when there is nothing to show.
    """
    log = run / LOG_FILE
    if not log.exists():
        raise CurveError(f"{run} is no folder of a run: it has no {LOG_FILE}")
    lines = [line for line in read_log(log) if line.get("group") == "validation"]
    if not lines:
        raise CurveError(f"{log} has no validation yet")
    known = [name for name in lines[-1] if name not in BOOKKEEPING]
    unknown = [name for name in metrics if name not in known]
    if unknown:
        raise CurveError(f"{log} has no {', '.join(unknown)}; it has {', '.join(known)}")
    stages = None if all("images" in line for line in lines) else _stages(run, config)
    rows = []
    for line in lines:
        seen = line["images"] if "images" in line else images_at(stages or [], line["step"])
        values = {name: float(line[name]) for name in metrics or known if name in line}
        rows.append({"step": float(line["step"]), "images": float(seen), **values})
    return rows


def images_at(stages: Sequence[dict[str, Any]], step: int) -> int:
    """Single frames drawn until a step of the stages of a config."""
    starts = [int(stage["from_step"]) for stage in stages] + [math.inf]
    ends = [min(step, end) for end in starts[1:]]
    return int(
        sum(
            stage["batch"] * max(0, end - start)
            for stage, start, end in zip(stages, starts[:-1], ends, strict=True)
        )
    )


def last_doubling(rows: Sequence[dict[str, float]], metric: str) -> tuple[float, float] | None:
    """(error at half the images, error at the end), interpolated; None for a shorter curve."""
    points = [(row["images"], row[metric]) for row in rows if metric in row and row["images"] > 0]
    if len(points) < 2 or points[-1][0] < 2 * points[0][0]:
        return None
    half = points[-1][0] / 2
    for (left, low), (right, high) in pairwise(points):
        if left <= half <= right and right > left:
            share = math.log(half / left) / math.log(right / left)
            return low + share * (high - low), points[-1][1]
    return None


def write_csv(rows: Sequence[dict[str, float]], path: Path) -> None:
    """Columns step, images and the metrics."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        for row in rows:
            counts = {"step": int(row["step"]), "images": int(row["images"])}
            writer.writerow({**row, **counts})


def draw_curve(rows: Sequence[dict[str, float]], path: Path, title: str) -> None:
    """A PNG with images on a logarithmic axis and one line a metric."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axis = pyplot.subplots(figsize=(7, 4), constrained_layout=True)
    for name in dict.fromkeys(name for row in rows for name in row):
        points = [(row["images"], row[name]) for row in rows if name in row and row["images"] > 0]
        if name not in BOOKKEEPING and points:
            axis.plot(*zip(*points, strict=True), marker="o", markersize=3, label=name)
    axis.set_xscale("log")
    axis.set_xlabel("images seen")
    axis.set_ylabel("error")
    axis.set_title(title)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _stages(run: Path, config: Path | None) -> list[dict[str, Any]]:
    """The `stages` of the run's settings."""
    path = config or run / CONFIG_FILE
    if path.exists():
        settings = yaml.safe_load(path.read_text())
    elif config is None and (run / STATE_FILE).exists():
        settings = torch.load(run / STATE_FILE, map_location="cpu", weights_only=True)["config"]
    else:
        raise CurveError(f"the log does not count images, and there is no {path}: give --config")
    stages: list[dict[str, Any]] = settings["stages"]
    return stages
