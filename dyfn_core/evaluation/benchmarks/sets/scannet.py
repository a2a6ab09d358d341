"""ScanNet's test split, exported: 100 scenes of a hand-held sensor."""

from __future__ import annotations

from pathlib import Path

from dyfn_core.data.frames import DataReport
from dyfn_core.data.rgbd.layouts import SCANNET
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkSettings, BenchmarkSource
from dyfn_core.evaluation.benchmarks.sets.rgbd import rgbd_sources

EXPECTED = (
    "<scene>/ with color/0.jpg, depth/0.png, pose/0.txt and intrinsic/intrinsic_color.txt "
    "(or the scenes in scans_test/)"
)
# 90 of the first 270 frames. The colour image is brought to the depth's size before the crop.
SETTINGS = BenchmarkSettings(stride=3, frames=90, depth_max=10, crop=(8, 11))
SCENES = tuple(f"scene{number:04}_00" for number in range(707, 807))
LENGTHS = dict.fromkeys(SCENES, 90)


def open_scannet(root: Path, report: DataReport) -> list[BenchmarkSource]:
    """uint16 millimetres, 0 invalid; colour 1296 x 968 is resized to the depth's 640 x 480."""
    return rgbd_sources(root, (SCANNET,), report, named=lambda folder: folder.name)
