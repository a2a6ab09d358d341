"""Dynamic Replica: people and animals in scanned rooms, PyTorch3D cameras."""

from __future__ import annotations

import gzip
import json
import re
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.data.axes import pytorch3d_pose
from dyfn_core.data.files import read_colour, read_float16_png, rgbd_frame
from dyfn_core.data.frames import DataReport, FrameError, FrameSequence, RgbdFrame, uninterrupted

EXPECTED = "<split>/frame_annotations_<split>.jgz and <split>/<sequence>_left/{images,depths}/"
BROKEN = ("009850-3_obj_source_left",)  # its depth does not belong to its images


@dataclass(frozen=True)
class Annotated:
    """One frame's files, camera (normalised intrinsics, camera to world) and depth factor."""

    image: Path
    depth: Path
    intrinsics: np.ndarray
    pose: np.ndarray
    factor: float


def open_dynamic_replica(
    root: Path, report: DataReport, *, subset: str = "train"
) -> list[FrameSequence]:
    """The left camera. Depth is a PNG of float16 bits; 0, inf and NaN are invalid.

    subset: train, valid or test; root may also be that folder itself. Assumed: depth is in
    metres (times the annotation's `scale_adjustment`, which is 1 where it is absent); no value
    means sky, these are rooms.
    """
    folder, annotations = _annotations(root, subset)
    if annotations is None:
        return []
    found: dict[str, dict[int, Annotated]] = defaultdict(dict)
    for entry in _entries(annotations):
        if entry.get("camera_name", "left") != "left":
            continue
        _add(entry, folder, found, report)
    sequences: list[FrameSequence] = []
    for name, frames in sorted(found.items()):
        if name in BROKEN:
            report.miss("sequence that is known to be broken", name)
        else:
            sequences += uninterrupted(name, list(frames), partial(_read, frames))
    return sequences


def _annotations(root: Path, subset: str) -> tuple[Path, Path | None]:
    """The folder that paths are relative to, and the file of annotations."""
    name = f"frame_annotations_{subset}.jgz"
    for folder, path in [
        (root / subset, root / subset / name),
        (root / subset, root / name),
        (root, root / name),
    ]:
        if folder.is_dir() and path.exists():
            return folder, path
    return root, None


def _entries(path: Path) -> list[dict[str, Any]]:
    try:
        with gzip.open(path, "rt", encoding="utf8") as file:
            entries = json.load(file)
    except (OSError, EOFError, ValueError) as error:
        raise FrameError(f"{path}: expected gzipped JSON: {error}") from error
    if not isinstance(entries, list):
        raise FrameError(f"{path}: expected a list of frame annotations")
    return entries


def _add(
    entry: dict[str, Any],
    folder: Path,
    found: dict[str, dict[int, Annotated]],
    report: DataReport,
) -> None:
    try:
        image, depth = folder / entry["image"]["path"], folder / entry["depth"]["path"]
        match = re.search(r"(\d+)\.[a-z]+$", image.name)
        number = int(match.group(1)) if match else int(entry["frame_number"])
        factor = float(entry["depth"].get("scale_adjustment") or 1)
        camera = _camera(entry["viewpoint"], entry["image"]["size"])
        name = Path(entry["image"]["path"]).parts[0]
    except (KeyError, TypeError, ValueError) as error:
        report.miss("annotation that lacks something", f"{entry.get('sequence_name')}: {error!r}")
        return
    for path, what in ((image, "image"), (depth, "depth")):
        if not path.exists():
            report.miss(f"annotated {what} that is not there", path)
            return
    found[name][number] = Annotated(image, depth, *camera, factor)


def _camera(viewpoint: dict[str, Any], size: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Normalised intrinsics and the pose. size: (H, W). NDC: x left, y up."""
    half = np.array([size[1], size[0]], np.float64) / 2
    layout = str(viewpoint.get("intrinsics_format", "ndc_norm_image_bounds")).lower()
    if layout not in ("ndc_norm_image_bounds", "ndc_isotropic"):
        raise ValueError(f"unknown intrinsics_format {layout!r}")
    unit = half if layout == "ndc_norm_image_bounds" else np.full(2, half.min())
    focal = np.array(viewpoint["focal_length"], np.float64) * unit / (2 * half)
    centre = (half - np.array(viewpoint["principal_point"], np.float64) * unit) / (2 * half)
    pose = pytorch3d_pose(np.array(viewpoint["R"]), np.array(viewpoint["T"]))
    return np.concatenate([focal, centre]).astype(np.float32), pose


def _read(frames: dict[int, Annotated], number: int) -> RgbdFrame:
    frame = frames[number]
    depth = read_float16_png(frame.depth) * np.float32(frame.factor)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))
    return rgbd_frame(read_colour(frame.image), depth, frame.intrinsics, frame.pose, frame.depth)
