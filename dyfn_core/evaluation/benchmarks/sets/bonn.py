"""Bonn RGB-D Dynamic: people and balloons in a room, laid out as TUM's sequences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from dyfn_core.data.frames import DataReport
from dyfn_core.data.rgbd.layouts import TUM
from dyfn_core.evaluation.benchmarks.sets.base import (
    BenchmarkFrame,
    BenchmarkSettings,
    BenchmarkSource,
)
from dyfn_core.evaluation.benchmarks.sets.rgbd import rgbd_sources

EXPECTED = (
    "rgbd_bonn_<name>/ with rgb.txt, depth.txt, rgb/<stamp>.png, depth/<stamp>.png "
    "(and groundtruth.txt)"
)
SETTINGS = BenchmarkSettings(first=30, frames=110, depth_max=10)
SCENES = tuple(
    f"rgbd_bonn_{name}"
    for name in ("balloon2", "crowd2", "crowd3", "person_tracking", "synchronous")
)
LENGTHS = dict.fromkeys(SCENES, 110)


def open_bonn(root: Path, report: DataReport) -> list[BenchmarkSource]:
    """uint16, 5000 a metre, 0 invalid. Depth is matched to colour by stamp, not by order.

    groundtruth.txt needs the calibration of the markers, which is not in the folders: no poses
    are taken.
    """
    sources = rgbd_sources(root, (TUM,), report, named=lambda folder: folder.name)
    return [replace(source, read=partial(_without_pose, source)) for source in sources]


def _without_pose(source: BenchmarkSource, numbers: Sequence[int]) -> Iterator[BenchmarkFrame]:
    return (replace(frame, pose=None) for frame in source.read(numbers))
