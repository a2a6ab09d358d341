"""Mid-Air: a drone's flights in rendered landscapes."""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.data.axes import ned_body_pose
from dyfn_core.data.files import (
    folders_holding,
    needed,
    numbered_files,
    read_colour,
    read_float16_png,
    rgbd_frame,
    usable_poses,
    with_depth,
)
from dyfn_core.data.frames import DataReport, FrameSequence, RgbdFrame, uninterrupted
from dyfn_core.geometry.rigid import quaternion_rotation, rigid

EXPECTED = (
    "<environment>/<climate>/ with color_left/trajectory_0000/000000.JPEG, "
    "depth/trajectory_0000/000000.PNG and sensor_records.hdf5"
)
SIZE = (1024, 1024)
FOCAL = 512.0
FARTHEST = 1250.0  # metres from the camera: sky
RECORDS_A_FRAME = 4  # poses come at 100 Hz, images at 25
INTRINSICS = np.array([0.5, 0.5, 0.5, 0.5], np.float32)


def open_midair(root: Path, report: DataReport) -> list[FrameSequence]:
    """The left camera, 1024 x 1024, 90 degrees. Depth is a PNG of float16 bits that holds the
    distance from the camera: z = d * 512 / sqrt(dx^2 + dy^2 + 512^2); 1250 m and more is sky.

    Poses: `groundtruth/position` and `attitude` (w x y z, body to world) of the frame's record.
    Assumed: the camera sits at the body's origin and looks forward; the principal point is the
    image's centre; 0 and NaN are invalid.
    """
    sequences: list[FrameSequence] = []
    for climate in folders_holding(root, "color_left", 3):
        for folder in sorted((climate / "color_left").glob("trajectory_*")):
            images = numbered_files(folder, r"(\d+)\.JPEG")
            depths = numbered_files(climate / "depth" / folder.name, r"(\d+)\.PNG")
            files = with_depth(images, depths, report)
            poses = _poses(climate / "sensor_records.hdf5", folder.name, report)
            name = str(folder.relative_to(root))
            sequences += uninterrupted(name, list(files), partial(_read, files, poses))
    return sequences


def _poses(path: Path, trajectory: str, report: DataReport) -> np.ndarray | None:
    """N x 7 at the images' rate: position and w x y z; None, counted, when unreadable."""
    library: Any = needed("h5py", path)
    try:
        with library.File(path, "r") as file:
            truth = file[trajectory]["groundtruth"]
            rows = np.hstack([truth["position"][()], truth["attitude"][()]])
        rows = rows[::RECORDS_A_FRAME].astype(np.float64)
    except (OSError, KeyError, ValueError) as error:
        report.miss(f"trajectory without poses: {error}", f"{path}: {trajectory}")
        return None
    return usable_poses(rows, path / trajectory, report, slice(3, 7))


@lru_cache(maxsize=1)
def _along_axis() -> np.ndarray:
    """z of a point at distance 1 in every pixel."""
    offset = np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2
    squares = offset[None, :] ** 2 + offset[:, None] ** 2
    return (FOCAL / np.sqrt(squares + FOCAL**2)).astype(np.float32)


def _read(files: dict[int, tuple[Path, Path]], poses: np.ndarray | None, number: int) -> RgbdFrame:
    image_path, depth_path = files[number]
    image, distance = read_colour(image_path, SIZE), read_float16_png(depth_path)
    frame = rgbd_frame(image, distance, INTRINSICS, _pose(poses, number), depth_path)
    depth = np.where(distance > 0, distance * _along_axis(), np.float32(np.nan))
    depth[distance >= FARTHEST] = np.inf
    return RgbdFrame(frame.image, depth, frame.intrinsics, frame.pose)


def _pose(poses: np.ndarray | None, number: int) -> np.ndarray | None:
    if poses is None or number >= len(poses) or not np.isfinite(poses[number]).all():
        return None
    row = poses[number]
    return ned_body_pose(rigid(quaternion_rotation(*row[3:]), row[:3]))
