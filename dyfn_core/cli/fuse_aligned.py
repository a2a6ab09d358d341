"""dyfn-eval reconstruct --fuse-aligned: figure 2 of the paper on any data with depth and poses."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tqdm import tqdm

from dyfn_core.cli.chosen_data import open_sequence, places
from dyfn_core.evaluation.reconstruction.aligned_fusion import (
    TABLE_NOTE,
    TRUTH,
    AlignedFusion,
    fuse_aligned,
    fusion_table,
)
from dyfn_core.evaluation.reconstruction.cloud_error import write_ply
from dyfn_core.evaluation.reconstruction.cloud_pictures import draw_fused
from dyfn_core.evaluation.report.html import (
    ReportPicture,
    Section,
    Text,
    text_table,
    write_report,
)
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.evaluation.report.tables import write_tables
from dyfn_core.geometry.voxel_grid import VoxelGrid
from dyfn_core.models.base import GeometryModel

COMPLETE, PARTIAL = 0, 3
Scores = dict[str, dict[str, Any]]


def run_fusion(options: argparse.Namespace, model: GeometryModel) -> int:
    """-> exit status. Raises ValueError, DataError or OSError for what is unusable."""
    sequence = open_sequence(options)
    chosen = tqdm(places(options, len(sequence)), unit="frame", file=sys.stderr)
    found = fuse_aligned(sequence, chosen, model, num_tokens=options.num_tokens)
    scores = found.values(options.tolerance)
    options.out.mkdir(parents=True, exist_ok=True)
    _write(options, found, scores, Path(sequence.name).name)
    print(text_table(fusion_table(scores)))
    for text, count in found.losses.items():
        print(f"dyfn-eval: loss: {text} ({count} times)", file=sys.stderr)
    return PARTIAL if found.losses else COMPLETE


def _write(options: argparse.Namespace, found: AlignedFusion, scores: Scores, name: str) -> None:
    out: Path = options.out
    clouds = {" ".join(key): one.cloud for key, one in found.clouds.items()}
    titles = _titles(scores)
    for key, cloud in [(TRUTH, found.truth), *clouds.items()]:
        write_ply(out / f"cloud_{key.replace(' ', '_').lower()}.ply", *cloud.cloud())
    figure = draw_fusion({TRUTH: found.truth, **clouds}, {TRUTH: TRUTH, **titles}, found)
    (out / "fusion.png").write_bytes(encode_picture(figure))
    table = fusion_table(scores)
    title = f"Aligned depth of {name}, fused with the true poses"
    write_tables(out, "fusion", table, title)
    given = {key: value for key, value in vars(options).items() if key not in ("run", "command")}
    shown = {key: str(v) if isinstance(v, Path) else v for key, v in given.items()}
    summary = {
        "sequence": name,
        "options": shown,
        "frames": len(found.poses),
        "runs": scores,
        "losses": dict(found.losses),
    }
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    (out / "fusion.json").write_text(text, encoding="utf-8")
    picture = ReportPicture(figure, "the fused clouds from above and obliquely")
    parts = [Section("Scores", [table, Text(TABLE_NOTE, note=True)]), Section("Clouds", [picture])]
    write_report(out / "report.html", title, parts)


def _titles(scores: Scores) -> dict[str, str]:
    return {
        f"{variant} {alignment}": f"{variant}, aligned {alignment}: AbsRel "
        f"{found['depth']['abs_rel']:.3f}, delta1 {found['depth']['delta1']:.3f}"
        for variant, alignments in scores.items()
        for alignment, found in alignments.items()
    }


def draw_fusion(
    clouds: dict[str, VoxelGrid], titles: dict[str, str], found: AlignedFusion
) -> np.ndarray:
    """A row per cloud, from above and obliquely, under its title; H x W x 3 uint8 RGB."""
    figure = Figure(figsize=(8.4, 3.6 * len(clouds)), dpi=100, layout="constrained")
    rows = figure.subplots(len(clouds), 1, squeeze=False)[:, 0]
    for axis, (key, cloud) in zip(rows, clouds.items(), strict=True):
        views = [draw_fused(*cloud.cloud(), found.poses, oblique=side) for side in (False, True)]
        axis.imshow(np.hstack(views))
        axis.set_title(titles[key], fontsize=10, loc="left")
        axis.set_axis_off()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    result: np.ndarray = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return result
