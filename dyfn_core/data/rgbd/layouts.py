"""The layouts of RGB-D folders, and how the frames of each are found."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dyfn_core.data.files import hidden, numbered_files, subfolders
from dyfn_core.data.frames import DataError, DataReport, FrameError
from dyfn_core.data.rgbd.cameras import (
    PUBLISHED_SIZE,
    SEVEN_SCENES_CAMERA,
    SEVEN_SCENES_DEPTH,
    Camera,
    FolderCamera,
    SensorInfo,
    published_camera,
    read_camera,
)
from dyfn_core.data.rgbd.folder import Calibration, FrameFiles, RgbdFolder
from dyfn_core.data.rgbd.lists import (
    Stamped,
    associated_files,
    read_poses,
    stamped_files,
    trajectory,
)
from dyfn_core.data.rgbd.names import (
    FIRST_TIME,
    TOLERANCE,
    entry,
    frame_numbers,
    nearest,
    paired,
    visible_files,
)
from dyfn_core.data.rgbd.units import MILLIMETRES, TUM_UNIT, signs_of_another

LAYOUTS = TUM, ASSOCIATIONS, SEVEN_SCENES, SCANNET, PLAIN = (
    "tum",
    "associations",
    "7scenes",
    "scannet",
    "plain",
)
EXPECTED = (
    "one of: rgb.txt and depth.txt (TUM); associations.txt; frame-000000.color.png, .depth.png, "
    ".pose.txt (7-Scenes); color/, depth/, pose/, intrinsic/ (ScanNet export); rgb/, depth/, K.txt"
)
ASSOCIATION_FILES = ("associations.txt", "associate.txt", "association.txt", "assoc.txt")
# Any other text file beside rgb/ whose first line names a colour and a depth file.
_NAMED = r"[\d.]+\s+\S*(?:rgb|colou?r|depth)\S*"
_ASSOCIATION = re.compile(rf"{_NAMED}\s+{_NAMED}")
COLOUR_FOLDERS = ("rgb", "color", "colour", "image", "images")  # all but the first: beside depth/
# Of depth laid over the colour images, before the sensor's own, which is in the last.
DEPTH_FOLDERS = (
    "aligned_depth",
    "depth_aligned",
    "aligned_depth_to_color",
    "depth_registered",
    "registered_depth",
    "depth",
)
CAMERA_FILES = (
    "K.txt",
    "intrinsics.txt",
    "camera-intrinsics.txt",
    "camera_intrinsics.txt",
    "calibration.txt",
)
SENSOR_INFO = ("info.txt", "_info.txt")  # of frames exported from a .sens file
COLOUR_SUFFIXES, DEPTH_SUFFIXES = (".jpg", ".jpeg", ".png"), (".png",)
TEXT_SUFFIXES = ("", ".txt", ".csv", ".json", ".yaml", ".yml", ".md", ".db", ".ini")
GROUND_TRUTH = "groundtruth.txt"
Poses = Mapping[Path, np.ndarray]  # by colour file


@dataclass(frozen=True)
class FolderOptions:
    """What a user may give instead of what a folder says.

    Attributes:
        intrinsics: fx, fy, cx, cy in pixels of the colour image.
        depth_scale: stored depth values per metre.
        tolerance: seconds between a colour frame and its depth, in folders with stamps.
        depth_offset: seconds that the stamps of depth.txt are after those of rgb.txt.
    """

    intrinsics: Camera | None = None
    depth_scale: float | None = None
    tolerance: float = TOLERANCE
    depth_offset: float = 0.0

    def calibration(self, file: Path, published: FolderCamera | None = None) -> Calibration:
        """Of a folder whose own is in this file."""
        given = None if self.intrinsics is None else FolderCamera(self.intrinsics, "intrinsics")
        return Calibration(given, file, published)


def layout_of(folder: Path) -> str | None:
    """One of LAYOUTS; None for a folder of another kind."""
    if not folder.is_dir():
        return None
    if entry(folder, "rgb.txt").is_file():
        return TUM
    if _association_file(folder) is not None:
        return ASSOCIATIONS
    if next(folder.glob("frame-*.color.*"), None) is not None:
        return SEVEN_SCENES
    colour, depth = _colour_folder(folder), depth_folder(folder)
    if colour.name.lower() == "color" and entry(folder, "intrinsic").is_dir():
        return SCANNET
    if not colour.is_dir():
        return None
    return PLAIN if depth.is_dir() or colour.name.lower() == COLOUR_FOLDERS[0] else None


def _colour_folder(folder: Path) -> Path:
    return entry(folder, *COLOUR_FOLDERS)


def depth_folder(folder: Path) -> Path:
    """Where the depth of a folder with pictures is, be it there or not."""
    place = entry(folder, *DEPTH_FOLDERS)
    return place if place.is_dir() else entry(folder, DEPTH_FOLDERS[-1])


def _camera_file(folder: Path, report: DataReport) -> Path:
    """K.txt, or another usual file of intrinsics if it can be read as such."""
    usual = entry(folder, CAMERA_FILES[0])
    if usual.exists():
        return usual
    for name in CAMERA_FILES[1:]:
        other = entry(folder, name)
        if other.exists():
            try:
                read_camera(other)
            except DataError as error:
                report.miss(f"file that may hold intrinsics and is not used: {error}", other)
            else:
                return other
    return usual


def find_folders(root: Path, levels: int) -> Iterator[Path]:
    """root and folders up to `levels` below it that have a layout, sorted by path; a folder that
    does is not looked into."""
    if not root.is_dir():
        return
    if layout_of(root) is not None:
        yield root
    elif levels > 0:
        for folder in subfolders(root):
            yield from find_folders(folder, levels - 1)


def open_folder(path: Path, report: DataReport, options: FolderOptions | None = None) -> RgbdFolder:
    """Find the frames of one folder; no picture is read.

    Args:
        path: of one of LAYOUTS.
        report: counts what is not paired or cannot be used.
        options: instead of what the folder says.

    Raises:
        DataError: the folder has no known layout or no colour image, or one of its text files is
            unreadable.
    """
    layout = layout_of(path)
    if layout is None:
        raise DataError(f"{path}: expected {EXPECTED}")
    options = options or FolderOptions()
    if options.depth_offset and layout != TUM:
        raise DataError(
            f"{path}: an offset of depth in time ({options.depth_offset:g} s) needs stamps of its "
            "own for depth, in rgb.txt and depth.txt"
        )
    try:
        opened = _OPENERS[layout](path, report, options)
    except FrameError as error:
        raise DataError(str(error)) from error
    if not opened.frames:
        found = [f"{len(what)} x {why} ({what[0]})" for why, what in report.problems.items()]
        held = "; ".join(["none", *found])
        raise DataError(f"{path}: expected colour images (jpg or png) and found {held}")
    return opened


def _plain(folder: Path, report: DataReport, options: FolderOptions) -> RgbdFolder:
    images = _files(_colour_folder(folder), COLOUR_SUFFIXES, report)
    poses: Poses = {}
    table = entry(folder, "poses.txt")
    if table.exists():
        rows = read_poses(table, report)
        if len(rows) != len(images):
            raise DataError(f"{table}: {len(rows)} poses for {len(images)} images")
        poses = {image: row for image, row in zip(images, rows, strict=True) if _finite(row)}
    frames = _in_folders(folder, images, poses, report)
    if options.depth_scale is None and any(frame.depth is not None for frame in frames):
        for sign in signs_of_another(folder, [f.image for f in frames if f.depth is not None]):
            report.miss(f"{sign}; read as {MILLIMETRES:g} a metre (--depth-scale)", folder)
    calibration = options.calibration(_camera_file(folder, report))
    return RgbdFolder(folder, PLAIN, frames, calibration, options.depth_scale or MILLIMETRES)


def _scannet(folder: Path, report: DataReport, options: FolderOptions) -> RgbdFolder:
    images = _files(_colour_folder(folder), COLOUR_SUFFIXES, report)
    texts = [path for path in visible_files(entry(folder, "pose")) if path.suffix == ".txt"]
    frames = _in_folders(folder, images, _pose_files(paired(images, texts), report), report)
    own = entry(entry(folder, "intrinsic"), "intrinsic_color.txt", "intrinsics_color.txt")
    calibration = options.calibration(own if own.exists() else _camera_file(folder, report))
    return RgbdFolder(folder, SCANNET, frames, calibration, options.depth_scale or MILLIMETRES)


def _seven_scenes(folder: Path, report: DataReport, options: FolderOptions) -> RgbdFolder:
    images = numbered_files(folder, r"frame-(\d+)\.color\.(?i:png|jpe?g)")
    depths = numbered_files(folder, r"frame-(\d+)\.depth\.(?i:png|pgm)")
    texts = numbered_files(folder, r"frame-(\d+)\.pose\.txt")
    poses = _pose_files({images[n]: texts[n] for n in images if n in texts}, report)
    pairs = {images[n]: depths[n] for n in images if n in depths}
    _count_lone(list(images.values()), list(depths.values()), pairs, report)
    frames = tuple(
        FrameFiles(number, image, pairs.get(image), poses.get(image))
        for number, image in images.items()
    )
    info = entry(folder, *SENSOR_INFO)
    sensor = SensorInfo.read(info) if info.exists() else None
    if sensor is not None:
        calibration = options.calibration(_camera_file(folder, report), sensor.camera)
        unit = options.depth_scale or sensor.unit
        return RgbdFolder(folder, SEVEN_SCENES, frames, calibration, unit)
    source = "published intrinsics of 7-Scenes"
    published = FolderCamera(SEVEN_SCENES_CAMERA, source, PUBLISHED_SIZE)
    calibration = options.calibration(_camera_file(folder, report), published)
    unit = options.depth_scale or MILLIMETRES
    depth_camera = FolderCamera(SEVEN_SCENES_DEPTH, source, PUBLISHED_SIZE)
    return RgbdFolder(folder, SEVEN_SCENES, frames, calibration, unit, depth_camera)


def _tum(folder: Path, report: DataReport, options: FolderOptions) -> RgbdFolder:
    colours = stamped_files(entry(folder, "rgb.txt"), report)
    table = entry(folder, "depth.txt")
    has_depth = table.exists() or entry(folder, "depth").exists()
    depths = stamped_files(table, report) if has_depth else []
    files = []
    for number, (stamp, image) in enumerate(colours):
        depth = nearest(depths, stamp + options.depth_offset, options.tolerance)
        if depth is None and has_depth:
            report.miss(f"image without depth within {options.tolerance} s", image)
        files.append(FrameFiles(number, image, depth, stamp=stamp))
    if not entry(folder, GROUND_TRUTH).exists():
        report.miss(f"folder without {GROUND_TRUTH} (its frames have no poses)", folder)
    opened = _listed(folder, TUM, files, report, options)
    if opened.with_depth or not depths:
        return opened
    return replace(opened, doubts=(_far(table, colours, depths, options),))


def _far(
    table: Path, colours: Sequence[Stamped], depths: Sequence[Stamped], options: FolderOptions
) -> str:
    """Says how far the stamps of depth are from the images', none of which is near one."""
    seconds = float(np.median([s for s, _ in depths]) - np.median([s for s, _ in colours]))
    side = "after" if seconds > 0 else "before"
    return (
        f"{table}: its stamps are {abs(seconds):.6g} s {side} those of the images (medians, "
        f"tolerance {options.tolerance:g}); if they are of another clock, --depth-offset "
        f"{seconds:.6g} takes that away"
    )


def _associations(folder: Path, report: DataReport, options: FolderOptions) -> RgbdFolder:
    table = _association_file(folder)
    assert table is not None, "layout_of has found it"
    entries = associated_files(table, report)
    stamps = [stamp for stamp, _, _ in entries]
    counted = all(stamp % 1 == 0 and stamp < FIRST_TIME for stamp in stamps)
    rising = all(a < b for a, b in pairwise(stamps))
    files = [
        FrameFiles(int(stamp), image, depth)
        if counted and rising
        else FrameFiles(number, image, depth, stamp=stamp)
        for number, (stamp, image, depth) in enumerate(entries)
    ]
    named = {path for _, *paths in entries for path in paths}
    for place in sorted({image.parent for _, image, _ in entries}):
        for path in visible_files(place):
            if path.suffix.lower() in COLOUR_SUFFIXES and path not in named:
                report.miss(f"picture that {table.name} does not name", path)
    return _listed(folder, ASSOCIATIONS, files, report, options)


def _listed(
    folder: Path,
    layout: str,
    files: Sequence[FrameFiles],
    report: DataReport,
    options: FolderOptions,
) -> RgbdFolder:
    """A folder whose files are in lists: poses by stamp, TUM's unit and calibrations."""
    truth = entry(folder, GROUND_TRUTH)
    if truth.exists():
        poses = trajectory(truth, report)
        files = [_placed(frame, poses, options.tolerance) for frame in files]
    for path in folder.glob("*.freiburg"):
        report.miss(f"trajectory that is not read (expected {GROUND_TRUTH})", path)
    calibration = options.calibration(_camera_file(folder, report), published_camera(folder))
    unit = options.depth_scale or TUM_UNIT
    return RgbdFolder(folder, layout, tuple(files), calibration, unit)


def _placed(
    frame: FrameFiles, poses: list[tuple[float, np.ndarray]], tolerance: float
) -> FrameFiles:
    if frame.stamp is None:
        return frame
    return replace(frame, pose=nearest(poses, frame.stamp, tolerance))


def _association_file(folder: Path) -> Path | None:
    usual = entry(folder, *ASSOCIATION_FILES)
    if usual.is_file():
        return usual
    if not (_colour_folder(folder).is_dir() or entry(folder, "depth").is_dir()):
        return None
    return next((path for path in sorted(folder.glob("*.txt")) if _associates(path)), None)


def _associates(path: Path) -> bool:
    """Whether a text file associates colour and depth files, whatever its name."""
    if hidden(path) or not path.is_file():
        return False
    with path.open("rb") as file:
        lines = file.read(4096).decode("utf-8-sig", "replace").splitlines()
    first = next((line.strip() for line in lines if line.strip() and line[:1] != "#"), "")
    return bool(_ASSOCIATION.match(first.lower()))


def _files(folder: Path, suffixes: tuple[str, ...], report: DataReport) -> list[Path]:
    """Pictures of these types in numeric order; files of other types that may be meant are
    counted."""
    found = []
    for path in visible_files(folder):
        suffix = path.suffix.lower()
        if suffix in suffixes:
            found.append(path)
        elif path.is_file() and suffix not in TEXT_SUFFIXES:
            expected = ", ".join(suffixes)
            report.miss(f"{suffix} file in {folder.name}/ that is not read ({expected} are)", path)
    return found


def _in_folders(
    folder: Path, images: list[Path], poses: Poses, report: DataReport
) -> tuple[FrameFiles, ...]:
    """The frames of these colour files, with depth/*.png that belong to them by name."""
    place = depth_folder(folder)
    for other in subfolders(folder):
        if place.is_dir() and other != place and other.name.lower() in DEPTH_FOLDERS:
            report.miss(f"folder of depth that is not read ({place.name}/ is, by its name)", other)
    depths = _files(place, DEPTH_SUFFIXES, report)
    pairs = paired(images, depths)
    if place.is_dir():
        _count_lone(images, depths, pairs, report)
    else:
        for other in subfolders(folder):
            if "depth" in other.name.lower():
                report.miss("folder of depth by its name that is not read (depth/ is)", other)
    return tuple(
        FrameFiles(number, image, pairs.get(image), poses.get(image))
        for number, image in zip(frame_numbers(images), images, strict=True)
    )


def _count_lone(
    images: list[Path], depths: list[Path], pairs: Mapping[Path, Path], report: DataReport
) -> None:
    """Count what has no partner."""
    used = set(pairs.values())
    for image in images:
        if image not in pairs:
            report.miss("image without depth", image)
    for depth in depths:
        if depth not in used:
            report.miss("depth without image", depth)


def _pose_files(texts: Mapping[Path, Path], report: DataReport) -> dict[Path, np.ndarray]:
    """4 x 4 camera to world of each colour file; those that cannot be used are counted."""
    poses = {}
    for image, path in texts.items():
        try:
            found = read_poses(path, DataReport(str(path)))
        except FrameError as error:
            report.miss(f"pose that cannot be read: {error}", path)
            continue
        if len(found) != 1:
            report.miss(f"pose file with {len(found)} poses", path)
        elif _finite(found[0]):
            poses[image] = found[0]
        else:
            report.miss("pose that is not finite (the frame stays)", path)
    return poses


def _finite(pose: np.ndarray) -> bool:
    return bool(np.isfinite(pose).all())


_OPENERS: dict[str, Callable[[Path, DataReport, FolderOptions], RgbdFolder]] = {
    TUM: _tum,
    ASSOCIATIONS: _associations,
    SEVEN_SCENES: _seven_scenes,
    SCANNET: _scannet,
    PLAIN: _plain,
}
