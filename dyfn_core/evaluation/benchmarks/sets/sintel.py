"""MPI Sintel's depth training set: 23 rendered sequences of at most 50 frames, 1024 x 436."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from dyfn_core.data.files import numbered_files, read_colour, with_depth
from dyfn_core.data.frames import DataReport, FrameError
from dyfn_core.evaluation.benchmarks.sets.base import (
    BenchmarkFrame,
    BenchmarkSettings,
    BenchmarkSource,
    one_by_one,
)
from dyfn_core.geometry.rigid import inverse

EXPECTED = (
    "training/{clean,final}/<sequence>/frame_0001.png and "
    "training/depth/<sequence>/frame_0001.dpt (and camdata_left/<sequence>/frame_0001.cam)"
)
SETTINGS = BenchmarkSettings(frames=50, depth_max=70)
TAG = np.float32(202021.25)  # how .dpt and .cam files begin
LENGTHS = {
    **dict.fromkeys(("alley_1", "alley_2"), 50),
    **{"ambush_2": 21, "ambush_4": 33, "ambush_5": 50, "ambush_6": 20, "ambush_7": 50},
    **dict.fromkeys(("bamboo_1", "bamboo_2", "bandage_1", "bandage_2", "cave_2", "cave_4"), 50),
    **{"market_2": 50, "market_5": 50, "market_6": 40, "mountain_1": 50},
    **dict.fromkeys(("shaman_2", "shaman_3", "sleeping_1", "sleeping_2"), 50),
    **dict.fromkeys(("temple_2", "temple_3"), 50),
}


def open_sintel(
    root: Path, report: DataReport, render_pass: str = "clean"
) -> list[BenchmarkSource]:
    """render_pass: "clean" (what the paper's numbers are of) or "final" (with blur and fog).

    Poses and intrinsics come from `camdata_left` where it is there.
    """
    base = root / "training" if (root / "training").is_dir() else root
    folders = base / render_pass
    found = []
    for folder in sorted(folders.iterdir()) if folders.is_dir() else []:
        images = numbered_files(folder, r"frame_(\d+)\.png")
        depths = numbered_files(base / "depth" / folder.name, r"frame_(\d+)\.dpt")
        cameras = numbered_files(base / "camdata_left" / folder.name, r"frame_(\d+)\.cam")
        files = with_depth(images, depths, report)
        if files:
            reader = partial(_read, files, cameras)
            found.append(BenchmarkSource(folder.name, list(files), one_by_one(reader)))
    return found


def _read(
    files: dict[int, tuple[Path, Path]], cameras: dict[int, Path], number: int
) -> BenchmarkFrame:
    image_path, depth_path = files[number]
    image, depth = read_colour(image_path), read_dpt(depth_path)
    if image.shape[:2] != depth.shape:
        raise FrameError(
            f"{depth_path}: depth of {depth.shape}, but the image has {image.shape[:2]}"
        )
    if number not in cameras:
        return BenchmarkFrame(image, depth)
    matrix, pose = read_cam(cameras[number])
    return BenchmarkFrame(image, depth, matrix, pose)


def read_dpt(path: Path) -> np.ndarray:
    """H x W float32 metres. Raises FrameError for a wrong tag or size."""
    header, data = _tagged(path, 8)
    width, height = np.frombuffer(header, "<i4")
    if width < 1 or height < 1 or len(data) != 4 * int(width) * int(height):
        raise FrameError(
            f"{path}: expected {width} x {height} float32 after the header, got {len(data)} bytes"
        )
    return np.frombuffer(data, "<f4").reshape(height, width).astype(np.float32)


def read_cam(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Camera matrix 3 x 3 and camera to world 4 x 4. Raises FrameError for another format."""
    _, data = _tagged(path, 0)
    if len(data) != 8 * 21:
        raise FrameError(f"{path}: expected 9 + 12 float64 after the tag, got {len(data)} bytes")
    values = np.frombuffer(data, "<f8")
    world_to_camera = np.eye(4)
    world_to_camera[:3] = values[9:].reshape(3, 4)
    return values[:9].reshape(3, 3).copy(), inverse(world_to_camera)


def _tagged(path: Path, header: int) -> tuple[bytes, bytes]:
    """What follows the tag: `header` bytes and the rest."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FrameError(f"{path}: cannot be read: {error}") from error
    if len(content) < 4 + header or np.frombuffer(content[:4], "<f4")[0] != TAG:
        raise FrameError(f"{path}: expected a Sintel file that begins with float32 {TAG}")
    return content[4 : 4 + header], content[4 + header :]
