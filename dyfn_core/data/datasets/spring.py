"""Spring: a rendered film, disparity in HDF5 at twice the image's size."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.data.files import (
    folders_holding,
    needed,
    numbered_files,
    read_colour,
    read_table,
    rgbd_frame,
    usable_poses,
    with_depth,
)
from dyfn_core.data.frames import (
    DataReport,
    FrameError,
    FrameSequence,
    RgbdFrame,
    camera_intrinsics,
    uninterrupted,
)
from dyfn_core.geometry.rigid import inverse

EXPECTED = (
    "train/0001/ with frame_left/frame_left_0001.png, disp1_left/disp1_left_0001.dsp5 and "
    "cam_data/{intrinsics,extrinsics}.txt"
)
SIZE = (1080, 1920)
BASELINE = 0.065  # metres


def open_spring(root: Path, report: DataReport) -> list[FrameSequence]:
    """The left camera, 1920 x 1080. z = fx * 0.065 / d; d = 0 is sky, NaN invalid.

    The disparity has twice the size and the image's pixels as unit: every second row and column
    is taken. Assumed: a negative disparity is invalid. Line n of cam_data is frame n, from 1.
    """
    sequences: list[FrameSequence] = []
    base = root / "train" if (root / "train").is_dir() else root
    for folder in folders_holding(base, "frame_left", 2):
        images = numbered_files(folder / "frame_left", r"frame_left_(\d+)\.png")
        depths = numbered_files(folder / "disp1_left", r"disp1_left_(\d+)\.dsp5")
        files = with_depth(images, depths, report)
        try:
            cameras = read_table(folder / "cam_data" / "intrinsics.txt", 4)
            path = folder / "cam_data" / "extrinsics.txt"
            poses = usable_poses(read_table(path, 16), path, report)
        except FrameError as error:
            report.miss(f"sequence without cameras: {error}", folder)
            continue
        rows = min(len(cameras), len(poses))
        for number in [number for number in files if not 1 <= number <= rows]:
            report.miss("frame without a line in cam_data", files.pop(number)[0])
        name = str(folder.relative_to(root))
        reader = partial(_read, files, cameras, poses.reshape(-1, 4, 4))
        sequences += uninterrupted(name, list(files), reader)
    return sequences


def _read(
    files: dict[int, tuple[Path, Path]], cameras: np.ndarray, poses: np.ndarray, number: int
) -> RgbdFrame:
    image_path, depth_path = files[number]
    fx, fy, cx, cy = cameras[number - 1]
    disparity = _disparity(depth_path)
    depth = np.full(disparity.shape, np.nan, np.float32)
    near = disparity > 0
    depth[near] = fx * BASELINE / disparity[near]
    depth[disparity == 0] = np.inf
    intrinsics = camera_intrinsics(fx, fy, cx, cy, SIZE, image_path)
    image = read_colour(image_path, SIZE)
    return rgbd_frame(image, depth, intrinsics, inverse(poses[number - 1]), depth_path)


def _disparity(path: Path) -> np.ndarray:
    library: Any = needed("h5py", path)
    try:
        with library.File(path, "r") as file:
            stored = file["disparity"][()]
    except (OSError, KeyError) as error:
        raise FrameError(f"{path}: expected HDF5 with the key `disparity`: {error}") from error
    if stored.shape != (2 * SIZE[0], 2 * SIZE[1]):
        raise FrameError(f"{path}: expected {2 * SIZE[0]} x {2 * SIZE[1]}, got {stored.shape}")
    result: np.ndarray = stored[::2, ::2].astype(np.float32)
    return result
