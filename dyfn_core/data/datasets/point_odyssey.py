"""PointOdyssey: long synthetic walks with moving people and animals."""

from __future__ import annotations

import zipfile
from functools import partial
from pathlib import Path

import numpy as np

from dyfn_core.data.files import (
    folders_holding,
    numbered_files,
    read_colour,
    read_uint16,
    rgbd_frame,
    usable_poses,
    with_depth,
)
from dyfn_core.data.frames import (
    DataReport,
    FrameSequence,
    RgbdFrame,
    camera_intrinsics,
    uninterrupted,
)
from dyfn_core.geometry.rigid import inverse

EXPECTED = "train/<sequence>/ with rgbs/rgb_00000.jpg, depths/depth_00000.png and anno.npz"
LARGEST_DEPTH = 1000.0  # metres, stored as 65535
ANNOTATIONS = ("anno.npz", "annot.npz")


def open_point_odyssey(
    root: Path, report: DataReport, *, subset: str = "train"
) -> list[FrameSequence]:
    """Version 1.2. Depth is uint16 / 65535 * 1000 m, 0 invalid.

    subset: the folder under root; root may also be that folder itself. Assumed: 65535 is
    everything at 1000 m and beyond and counts as infinite; row i of the annotations is frame i.
    """
    base = root / subset if (root / subset).is_dir() else root
    sequences: list[FrameSequence] = []
    for folder in folders_holding(base, "rgbs", 2):
        images = numbered_files(folder / "rgbs", r"rgb_(\d+)\.jpg")
        depths = numbered_files(folder / "depths", r"depth_(\d+)\.png")
        cameras = _cameras(folder, report)
        if cameras is None:
            continue
        files = with_depth(images, depths, report)
        for number in [number for number in files if number >= len(cameras[0])]:
            report.miss("frame without a row in the annotations", files.pop(number)[0])
        name = str(folder.relative_to(root))
        sequences += uninterrupted(name, list(files), partial(_read, files, *cameras))
    return sequences


def _cameras(folder: Path, report: DataReport) -> tuple[np.ndarray, np.ndarray] | None:
    """Intrinsics N x 3 x 3 in pixels and extrinsics N x 4 x 4, world to camera."""
    path = next((folder / name for name in ANNOTATIONS if (folder / name).exists()), None)
    if path is None:
        report.miss(f"sequence without {' or '.join(ANNOTATIONS)}", folder)
        return None
    try:
        with np.load(path) as arrays:
            intrinsics, extrinsics = arrays["intrinsics"], arrays["extrinsics"]
        intrinsics = intrinsics.reshape(-1, 3, 3)
        poses = usable_poses(extrinsics.reshape(len(intrinsics), 16), path, report)
        return intrinsics, poses.reshape(-1, 4, 4)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        report.miss("annotations without N x 3 x 3 intrinsics and N x 4 x 4 extrinsics", path)
        report.miss(f"{type(error).__name__}: {error}", path)
        return None


def _read(
    files: dict[int, tuple[Path, Path]],
    intrinsics: np.ndarray,
    extrinsics: np.ndarray,
    number: int,
) -> RgbdFrame:
    image_path, depth_path = files[number]
    image, stored = read_colour(image_path), read_uint16(depth_path)
    depth = stored.astype(np.float32) * np.float32(LARGEST_DEPTH / 65535)
    depth[stored == 0] = np.nan
    depth[stored == 65535] = np.inf
    k = intrinsics[number]
    camera = camera_intrinsics(k[0, 0], k[1, 1], k[0, 2], k[1, 2], image.shape[:2], image_path)
    pose = inverse(extrinsics[number].astype(np.float64))
    return rgbd_frame(image, depth, camera, pose, depth_path)
