"""KITTI depth completion's validation drives, whose truth is accumulated lidar."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from dyfn_core.data.files import folders_holding, numbered_files, read_colour, read_uint16
from dyfn_core.data.frames import DataReport, FrameError
from dyfn_core.evaluation.benchmarks.sets.base import (
    BenchmarkFrame,
    BenchmarkSettings,
    BenchmarkSource,
    one_by_one,
)

EXPECTED = (
    "[val/]<drive>/proj_depth/groundtruth/image_02/0000000005.png and, in the root or raw/, "
    "<date>/<drive>/image_02/data/0000000005.png (and <date>/calib_cam_to_cam.txt)"
)
SETTINGS = BenchmarkSettings(frames=110, depth_max=80)
UNIT = 256.0  # stored values a metre
DRIVES = tuple(
    f"{drive}_sync"
    for drive in (
        *(f"2011_09_26_drive_{n:04}" for n in (2, 5, 13, 20, 23, 36, 79, 95, 113)),
        "2011_09_28_drive_0037",
        "2011_09_29_drive_0026",
        "2011_09_30_drive_0016",
        "2011_10_03_drive_0047",
    )
)


def open_kitti(root: Path, report: DataReport) -> list[BenchmarkSource]:
    """The left colour camera; uint16 / 256 metres, 0 invalid. Frames are those with truth."""
    found = []
    for folder in folders_holding(root, "proj_depth", 3):
        depths = numbered_files(folder / "proj_depth/groundtruth/image_02", r"(\d+)\.png")
        images: dict[int, Path] = {}
        for candidate in _image_folders(root, folder):
            images = images or numbered_files(candidate, r"(\d+)\.(?:png|jpg)")
        for number in depths.keys() - images.keys():
            report.miss("depth without image", depths[number])
        files = {n: (images[n], depths[n]) for n in depths if n in images}
        if files:
            reader = partial(_read, files, _camera_matrix(root, folder.name, report))
            found.append(BenchmarkSource(folder.name, list(files), one_by_one(reader)))
    return found


def _image_folders(root: Path, drive: Path) -> Iterator[Path]:
    date = drive.name[:10]
    yield drive / "image_02" / "data"
    for base in (root, root / "raw", root / "raw_data", root.parent / "raw"):
        yield base / date / drive.name / "image_02" / "data"


def _camera_matrix(root: Path, drive: str, report: DataReport) -> np.ndarray | None:
    """P_rect_02's left 3 x 3; None, counted, when there is no readable calibration."""
    for base in (root, root / "raw", root / "raw_data", root.parent / "raw"):
        path = base / drive[:10] / "calib_cam_to_cam.txt"
        if path.exists():
            for line in path.read_text(errors="replace").splitlines():
                name, _, values = line.partition(":")
                numbers = values.split()
                if name == "P_rect_02" and len(numbers) == 12:
                    return np.array(numbers, np.float64).reshape(3, 4)[:, :3]
            report.miss("calibration without P_rect_02 of 12 numbers", path)
    return None


def _read(
    files: dict[int, tuple[Path, Path]], camera_matrix: np.ndarray | None, number: int
) -> BenchmarkFrame:
    image_path, depth_path = files[number]
    image, stored = read_colour(image_path), read_uint16(depth_path)
    if image.shape[:2] != stored.shape:
        raise FrameError(
            f"{depth_path}: depth of {stored.shape}, but the image has {image.shape[:2]}"
        )
    depth = stored.astype(np.float32) / np.float32(UNIT)
    depth[stored == 0] = np.nan
    return BenchmarkFrame(image, depth, camera_matrix)
