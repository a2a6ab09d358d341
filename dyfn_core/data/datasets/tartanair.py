"""TartanAir, version 1: aggressive camera motion through many rendered places."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from dyfn_core.data.axes import ned_body_pose
from dyfn_core.data.files import (
    folders_holding,
    numbered_files,
    read_colour,
    read_table,
    rgbd_frame,
    usable_poses,
    with_depth,
)
from dyfn_core.data.frames import DataReport, FrameError, FrameSequence, RgbdFrame, uninterrupted
from dyfn_core.geometry.rigid import quaternion_rotation, rigid

EXPECTED = (
    "<environment>/{Easy,Hard}/P000/ with image_left/000000_left.png, "
    "depth_left/000000_left_depth.npy and pose_left.txt"
)
SIZE = (480, 640)
INTRINSICS = np.array([320 / 640, 320 / 480, 0.5, 0.5], np.float32)
FARTHEST = 5000.0  # metres: sky is stored as about 10000


def open_tartanair(root: Path, report: DataReport) -> list[FrameSequence]:
    """The left camera, 640 x 480, f = 320. Depth in metres.

    Poses: tx ty tz qx qy qz qw, camera to world, NED, a line a frame. Assumed: 5000 m and more
    is sky; 0, negative values and NaN are invalid; the principal point is the image's centre.
    """
    sequences: list[FrameSequence] = []
    for folder in folders_holding(root, "image_left", 4):
        images = numbered_files(folder / "image_left", r"(\d+)_left\.png")
        depths = numbered_files(folder / "depth_left", r"(\d+)_left_depth\.npy")
        files = with_depth(images, depths, report)
        poses = None
        try:
            path = folder / "pose_left.txt"
            poses = usable_poses(read_table(path, 7), path, report, slice(3, 7))
        except FrameError as error:
            report.miss(f"trajectory without poses: {error}", folder)
        name = str(folder.relative_to(root))
        sequences += uninterrupted(name, list(files), partial(_read, files, poses))
    return sequences


def _read(files: dict[int, tuple[Path, Path]], poses: np.ndarray | None, number: int) -> RgbdFrame:
    image_path, depth_path = files[number]
    try:
        stored = np.load(depth_path)
    except (OSError, ValueError, EOFError) as error:
        raise FrameError(f"{depth_path}: expected an array of metres: {error}") from error
    depth = np.where(stored > 0, stored, np.nan).astype(np.float32)
    depth[depth >= FARTHEST] = np.inf
    image = read_colour(image_path, SIZE)
    return rgbd_frame(image, depth, INTRINSICS, _pose(poses, number), depth_path)


def _pose(poses: np.ndarray | None, number: int) -> np.ndarray | None:
    if poses is None or number >= len(poses) or not np.isfinite(poses[number]).all():
        return None
    x, y, z, w = poses[number, 3:]
    return ned_body_pose(rigid(quaternion_rotation(w, x, y, z), poses[number, :3]))
