"""7-Scenes: seven rooms, tracked by KinectFusion. Its test sequences; not in the paper's tables."""

from __future__ import annotations

from pathlib import Path

from dyfn_core.data.frames import DataReport
from dyfn_core.data.rgbd.layouts import SEVEN_SCENES
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkSettings, BenchmarkSource
from dyfn_core.evaluation.benchmarks.sets.rgbd import rgbd_sources

EXPECTED = "<scene>/seq-01/ with frame-000000.color.png, .depth.png and .pose.txt"
SETTINGS = BenchmarkSettings(depth_max=10)
TEST_SPLIT = {
    "chess": (3, 5),
    "fire": (3, 4),
    "heads": (1,),
    "office": (2, 6, 7, 9),
    "pumpkin": (1, 7),
    "redkitchen": (3, 4, 6, 12, 14),
    "stairs": (1, 4),
}
SEQUENCES = tuple(
    f"{scene}/seq-{number:02}" for scene, numbers in TEST_SPLIT.items() for number in numbers
)


def open_seven_scenes(root: Path, report: DataReport) -> list[BenchmarkSource]:
    """uint16 millimetres, 0 and 65535 invalid; colour of focal length 525, depth of 585."""
    return rgbd_sources(
        root,
        (SEVEN_SCENES,),
        report,
        named=lambda folder: f"{folder.parent.name}/{folder.name}",
    )
