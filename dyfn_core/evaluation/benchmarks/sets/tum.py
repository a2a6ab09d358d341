"""TUM RGB-D: a hand-held sensor with poses of motion capture. Not in the paper's tables."""

from __future__ import annotations

from pathlib import Path

from dyfn_core.data.frames import DataReport
from dyfn_core.data.rgbd.layouts import TUM
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkSettings, BenchmarkSource
from dyfn_core.evaluation.benchmarks.sets.rgbd import rgbd_sources

EXPECTED = (
    "rgbd_dataset_freiburg<N>_<name>/ with rgb.txt, depth.txt, groundtruth.txt, rgb/<stamp>.png "
    "and depth/<stamp>.png"
)
SETTINGS = BenchmarkSettings(depth_max=10)


def open_tum(root: Path, report: DataReport) -> list[BenchmarkSource]:
    """uint16, 5000 a metre, 0 invalid; the published intrinsics of freiburg1, 2 and 3."""
    return rgbd_sources(root, (TUM,), report, named=lambda folder: folder.name)
