"""Folders of RGB-D frames as TUM, 7-Scenes, ScanNet exports and this project lay them out."""

from __future__ import annotations

import bisect
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from dyfn_core.data.axes import quaternion_rotation, rigid
from dyfn_core.data.files import (
    folders_holding,
    numbered_files,
    read_colour,
    read_table,
    read_uint16,
    registered,
    rgbd_frame,
    usable_poses,
    with_depth,
)
from dyfn_core.data.frames import (
    DataError,
    DataReport,
    FrameError,
    FrameSequence,
    RgbdFrame,
    camera_intrinsics,
    uninterrupted,
)

EXPECTED = (
    "one of: rgb.txt and depth.txt (TUM); frame-000000.color.png, .depth.png, .pose.txt "
    "(7-Scenes); color/, depth/, pose/, intrinsic/ (ScanNet export); rgb/, depth/, K.txt"
)
Thing = TypeVar("Thing")
Camera = tuple[float, float, float, float]  # fx, fy, cx, cy in pixels of the colour image
# The published calibrations of cameras whose folders come without one.
TUM_CAMERAS: dict[str, Camera] = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
    "bonn": (542.822841, 542.576870, 315.593520, 237.756098),
}
SEVEN_SCENES_CAMERA: Camera = (585.0, 585.0, 320.0, 240.0)


@dataclass(frozen=True)
class RgbdFolderOptions:
    """intrinsics: instead of the folder's own. depth_scale: stored values per metre instead of
    the layout's. tolerance, max_gap: seconds, for folders with stamps. max_missing: frames, for
    the others."""

    intrinsics: Camera | None
    depth_scale: float | None
    tolerance: float
    max_gap: float
    max_missing: int


@dataclass(frozen=True)
class Views:
    """The frames of one folder by number.

    camera: pixels of the colour image. poses: camera to world by number. unit: stored depth
    values per metre; 0 and those in `invalid` are none. stamps: seconds by number.
    """

    files: dict[int, tuple[Path, Path]]
    camera: Camera
    poses: dict[int, np.ndarray]
    unit: float
    invalid: tuple[int, ...] = ()
    stamps: dict[int, float] = field(default_factory=dict)


def open_rgbd_folder(
    root: Path,
    report: DataReport,
    *,
    intrinsics: Camera | None = None,
    depth_scale: float | None = None,
    tolerance: float = 0.02,
    max_gap: float = 0.5,
    max_missing: int = 2,
) -> list[FrameSequence]:
    """All folders of a known layout in root and two levels below it.

    Depth is uint16 along the optical axis, 0 invalid: millimetres, in TUM's layout 5000 a metre;
    depth_scale: other values per metre. intrinsics: fx, fy, cx, cy in pixels of the colour image,
    where the folder has none (TUM has none; the published ones are taken when the path names
    freiburg1, 2, 3 or bonn; 7-Scenes: 585, 585, 320, 240). tolerance: seconds between a colour
    frame and its depth, max_gap: seconds between frames that are a cut (both TUM only).
    max_missing: more frames than this missing from the numbers are a cut (other layouts).
    Raises DataError without intrinsics.
    """
    options = RgbdFolderOptions(intrinsics, depth_scale, tolerance, max_gap, max_missing)
    sequences: list[FrameSequence] = []
    for folder in folders_holding(root, "rgb.txt", 2):
        views, runs = _tum(folder, options, report)
        for run in runs:
            sequences += uninterrupted(str(folder), run, partial(_read, views), len(views.files))
    for entry, layout in (
        ("frame-*.color.*", _seven_scenes),
        ("color", _scannet),
        ("rgb", _plain),
    ):
        for folder in folders_holding(root, entry, 2):
            if not (folder / "rgb.txt").exists():
                views = layout(folder, options, report)
                numbers = sorted(views.files)
                reader = partial(_read, views)
                largest = _usual_step(numbers) * (1 + max_missing)
                sequences += uninterrupted(str(folder), numbers, reader, largest)
    return sequences


def is_rgbd_folder(root: Path) -> bool:
    """Whether root or a folder two levels below has a known layout."""
    entries = ("rgb.txt", "frame-*.color.*", "color", "rgb")
    return any(next(folders_holding(root, entry, 2), None) is not None for entry in entries)


def _read(views: Views, number: int) -> RgbdFrame:
    image_path, depth_path = views.files[number]
    image, stored = read_colour(image_path), read_uint16(depth_path)
    depth = stored.astype(np.float32) / np.float32(views.unit)
    depth[np.isin(stored, (0, *views.invalid))] = np.nan
    intrinsics = camera_intrinsics(*views.camera, image.shape[:2], image_path)
    image, depth = registered(image, depth, depth_path)
    frame = rgbd_frame(image, depth, intrinsics, views.poses.get(number), depth_path)
    return replace(frame, stamp=views.stamps.get(number))


def _usual_step(numbers: list[int]) -> int:
    """The most common difference of neighbours: exports may hold every tenth frame."""
    steps = Counter(np.diff(numbers).tolist())
    return steps.most_common(1)[0][0] if steps else 1


def _plain(folder: Path, options: RgbdFolderOptions, report: DataReport) -> Views:
    images = numbered_files(folder / "rgb", r"(?:.*\D)?(\d+)\.(?:jpg|jpeg|png)")
    depths = numbered_files(folder / "depth", r"(?:.*\D)?(\d+)\.png")
    poses: dict[int, np.ndarray] = {}
    if (folder / "poses.txt").exists():
        path = folder / "poses.txt"
        rows = usable_poses(read_table(path, 16), path, report).reshape(-1, 4, 4)
        if len(rows) != len(images):
            raise DataError(f"{folder}/poses.txt: {len(rows)} poses for {len(images)} images")
        poses = dict(zip(images, rows, strict=True))
    camera = options.intrinsics or _matrix_camera(folder / "K.txt", 3)
    files = with_depth(images, depths, report)
    return Views(files, camera, poses, options.depth_scale or 1000.0)


def _scannet(folder: Path, options: RgbdFolderOptions, report: DataReport) -> Views:
    images = numbered_files(folder / "color", r"(\d+)\.(?:jpg|png)")
    files = with_depth(images, numbered_files(folder / "depth", r"(\d+)\.png"), report)
    camera = options.intrinsics or _matrix_camera(folder / "intrinsic" / "intrinsic_color.txt", 4)
    poses = _pose_files(numbered_files(folder / "pose", r"(\d+)\.txt"), report)
    return Views(files, camera, poses, options.depth_scale or 1000.0)


def _seven_scenes(folder: Path, options: RgbdFolderOptions, report: DataReport) -> Views:
    images = numbered_files(folder, r"frame-(\d+)\.color\.(?:png|jpg)")
    files = with_depth(images, numbered_files(folder, r"frame-(\d+)\.depth\.png"), report)
    camera = options.intrinsics or SEVEN_SCENES_CAMERA
    poses = _pose_files(numbered_files(folder, r"frame-(\d+)\.pose\.txt"), report)
    return Views(files, camera, poses, options.depth_scale or 1000.0, (65535,))


def _pose_files(files: dict[int, Path], report: DataReport) -> dict[int, np.ndarray]:
    """4 x 4 camera to world, a file a frame; those that are not finite are counted."""
    poses = {}
    for number, path in files.items():
        try:
            pose = read_table(path, 16).reshape(4, 4)
        except (FrameError, ValueError) as error:
            report.miss(f"pose that cannot be read: {error}", path)
            continue
        if np.isfinite(pose).all():
            poses[number] = pose
        else:
            report.miss("pose that is not finite (the frame stays)", path)
    return poses


def _matrix_camera(path: Path, size: int) -> Camera:
    if not path.exists():
        raise DataError(
            f"{path} is missing; give `intrinsics: [fx, fy, cx, cy]` in pixels of the colour image"
        )
    matrix = read_table(path, size)
    if matrix.shape != (size, size):
        raise DataError(f"{path}: expected a {size} x {size} camera matrix")
    return (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])


def _tum(
    folder: Path, options: RgbdFolderOptions, report: DataReport
) -> tuple[Views, list[list[int]]]:
    """The views, numbered in the order of time, and runs without a gap."""
    colours = list(_stamped(folder / "rgb.txt", report))
    depths = list(_stamped(folder / "depth.txt", report))
    poses = list(_trajectory(folder / "groundtruth.txt", report))
    files: dict[int, tuple[Path, Path]] = {}
    placed: dict[int, np.ndarray] = {}
    runs: list[list[int]] = []
    previous = -np.inf
    for number, (stamp, path) in enumerate(colours):
        depth = _nearest(depths, stamp, options.tolerance)
        if depth is None:
            report.miss(f"image without depth within {options.tolerance} s", path)
            continue
        files[number] = (path, depth)
        pose = _nearest(poses, stamp, options.tolerance)
        if pose is not None:
            placed[number] = pose
        if stamp - previous > options.max_gap:
            runs.append([])
        runs[-1].append(number)
        previous = stamp
    camera = options.intrinsics or _tum_camera(folder)
    stamps = {number: colours[number][0] for number in files}
    return Views(files, camera, placed, options.depth_scale or 5000.0, stamps=stamps), runs


def _tum_camera(folder: Path) -> Camera:
    named = str(folder.resolve()).lower()
    known = [camera for name, camera in TUM_CAMERAS.items() if name in named]
    return known[-1] if known else _matrix_camera(folder / "K.txt", 3)


def _stamped(path: Path, report: DataReport) -> Iterator[tuple[float, Path]]:
    """Lines `stamp file`, sorted by stamp; files that are not there are counted."""
    entries = []
    for line in _lines(path):
        match = re.fullmatch(r"([\d.eE+-]+)\s+(\S.*)", line)
        if not match:
            raise DataError(f"{path}: expected lines of `stamp file`, got {line!r}")
        entries.append((float(match.group(1)), path.parent / match.group(2)))
    for stamp, file in sorted(entries):
        if file.exists():
            yield stamp, file
        else:
            report.miss(f"file named in {path.name} that is not there", file)


def _trajectory(path: Path, report: DataReport) -> Iterator[tuple[float, np.ndarray]]:
    """Lines `stamp tx ty tz qx qy qz qw`, camera to world, sorted by stamp."""
    if not path.exists():
        report.miss("folder without groundtruth.txt (its frames have no poses)", path.parent)
        return
    rows = usable_poses(read_table(path, 8), path, report, slice(4, 8))
    rows = rows[np.isfinite(rows).all(1)]
    for stamp, tx, ty, tz, qx, qy, qz, qw in sorted(rows.tolist()):
        yield stamp, rigid(quaternion_rotation(qw, qx, qy, qz), np.array([tx, ty, tz]))


def _lines(path: Path) -> list[str]:
    try:
        lines = (line.strip() for line in path.read_text().splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    return [line for line in lines if line and not line.startswith("#")]


def _nearest(entries: list[tuple[float, Thing]], stamp: float, tolerance: float) -> Thing | None:
    """The entry nearest to the stamp; None when it is farther than the tolerance."""
    place = bisect.bisect_left(entries, stamp, key=lambda entry: entry[0])
    beside = entries[max(0, place - 1) : place + 1]
    best = min(beside, key=lambda entry: abs(entry[0] - stamp), default=None)
    return None if best is None or abs(best[0] - stamp) > tolerance else best[1]
