"""KenBurns3D: walks and flights through rendered scenes, four views of each."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np

from dyfn_core.data.files import (
    folders_holding,
    numbered_files,
    read_colour,
    read_exr,
    rgbd_frame,
    with_depth,
)
from dyfn_core.data.frames import DataReport, FrameError, FrameSequence, RgbdFrame, uninterrupted

EXPECTED = (
    "<scene>-flying/00000-bl-image.png with 00000-meta.json beside it, and "
    "<scene>-flying-depth/00000-bl-depth.exr (or -walking)"
)
SIZE = (512, 512)
DEPTH_UNIT = 100.0  # stored values per metre
FARTHEST = 600.0  # metres


def open_ken_burns(root: Path, report: DataReport) -> list[FrameSequence]:
    """The bottom-left view, 512 x 512. f = 256 / tan(fltFov / 2), each sample its own. No poses.

    600 m and more is infinite. Assumed: depth is stored in centimetres along the optical axis, 0
    and what is not finite is invalid, fltFov is in degrees, and samples with neighbouring numbers
    are neighbours in time.
    """
    sequences: list[FrameSequence] = []
    for folder in folders_holding(root, "*-bl-image.png", 2):
        images = numbered_files(folder, r"(\d+)-bl-image\.png")
        metas = numbered_files(folder, r"(\d+)-meta\.json")
        depth_folder = folder.with_name(f"{folder.name}-depth")
        files = with_depth(images, numbered_files(depth_folder, r"(\d+)-bl-depth\.exr"), report)
        for number in files.keys() - metas.keys():
            report.miss("image without meta.json", files.pop(number)[0])
        name = str(folder.relative_to(root))
        sequences += uninterrupted(name, list(files), partial(_read, files, metas))
    return sequences


def _read(files: dict[int, tuple[Path, Path]], metas: dict[int, Path], number: int) -> RgbdFrame:
    image_path, depth_path = files[number]
    depth = read_exr(depth_path) / np.float32(DEPTH_UNIT)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))
    depth[depth >= FARTHEST] = np.inf
    focal = _focal(metas[number])
    intrinsics = np.array([focal, focal, 0.5, 0.5], np.float32)
    return rgbd_frame(read_colour(image_path, SIZE), depth, intrinsics, None, depth_path)


def _focal(path: Path) -> float:
    """Focal length in units of the image's side."""
    try:
        degrees = float(json.loads(path.read_text())["fltFov"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FrameError(f"{path}: expected JSON with `fltFov` in degrees: {error!r}") from error
    if not 0 < degrees < 180:
        raise FrameError(f"{path}: fltFov must lie between 0 and 180 degrees, got {degrees}")
    return float(0.5 / np.tan(np.radians(degrees) / 2))
