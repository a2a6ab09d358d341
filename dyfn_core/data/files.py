"""Finding and reading the files that data sets are made of."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dyfn_core.data.frames import DataError, DataReport, FrameError, RgbdFrame
from dyfn_core.data.heads import told_by_head

LISTED = 8  # entries of a folder that an error names
EXR_CHANNELS = ("Y", "Z", "V", "R")  # where a one-channel picture may be
SAME_ASPECT = 0.02  # relative difference at which colour and depth are the same view


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Files whose whole name matches `pattern` (a regular expression with one group, the frame
    number) -> by number, in numeric order. Nothing when there is no such folder."""
    if not folder.is_dir():
        return {}
    matcher = re.compile(pattern)
    found = ((matcher.fullmatch(path.name), path) for path in folder.iterdir())
    return dict(sorted((int(match.group(1)), path) for match, path in found if match))


def hidden(path: Path) -> bool:
    """Whether a name is no data: it begins with a dot (`.DS_Store`, `._0.png`), or `__MACOSX`."""
    return path.name.startswith(".") or path.name == "__MACOSX"


def subfolders(folder: Path) -> list[Path]:
    """The folders in a folder, sorted, without hidden ones."""
    return sorted(path for path in folder.iterdir() if path.is_dir() and not hidden(path))


def folders_holding(root: Path, entry: str, depth: int) -> Iterator[Path]:
    """root and folders up to `depth` levels below that hold something matching the glob `entry`,
    sorted by path; a folder that does is not looked into."""
    if not root.is_dir():
        return
    if next(root.glob(entry), None) is not None:
        yield root
    elif depth > 0:
        for path in subfolders(root):
            yield from folders_holding(path, entry, depth - 1)


def with_depth(
    images: dict[int, Path], depths: dict[int, Path], report: DataReport
) -> dict[int, tuple[Path, Path]]:
    """Frames that have both files; those that lack one are counted in the report."""
    for number in images.keys() - depths.keys():
        report.miss("image without depth", images[number])
    for number in depths.keys() - images.keys():
        report.miss("depth without image", depths[number])
    return {number: (images[number], depths[number]) for number in images if number in depths}


def nothing_found(root: Path, expected: str) -> DataError:
    """The error for a root that holds nothing of a kind."""
    if not root.exists():
        return DataError(f"{root} does not exist; expected {expected}")
    entries = sorted(path.name for path in root.iterdir()) if root.is_dir() else [root.name]
    listed = ", ".join(entries[:LISTED]) + (", ..." if len(entries) > LISTED else "")
    return DataError(f"{root}: expected {expected}; found {listed or 'an empty folder'}")


def usable_poses(
    rows: np.ndarray, path: Path, report: DataReport, quaternion: slice | None = None
) -> np.ndarray:
    """Poses, N x k, with NaN in the place of those that are none; these are counted.

    quaternion: the columns that hold one, which must not be of length 0. rgbd_frame gives the
    frames of such rows no pose.
    """
    usable = np.isfinite(rows).all(1)
    if quaternion is not None:
        usable &= (rows[:, quaternion] != 0).any(1)
    for number in np.flatnonzero(~usable):
        report.miss("pose that is none (the frame stays)", f"{path} row {number}")
    return np.where(usable[:, None], rows, np.nan)


def rgbd_frame(
    image: np.ndarray,
    depth: np.ndarray,
    intrinsics: np.ndarray,
    pose: np.ndarray | None,
    path: Path,
) -> RgbdFrame:
    """A frame whose depth has the image's size. Raises FrameError, naming `path`, if not.

    A pose that is not finite becomes None.
    """
    if image.shape[:2] != depth.shape:
        raise FrameError(f"{path}: depth of {depth.shape}, but the image has {image.shape[:2]}")
    if pose is not None and not np.isfinite(pose).all():
        pose = None
    return RgbdFrame(image, depth.astype(np.float32, copy=False), intrinsics, pose)


def registered(image: np.ndarray, depth: np.ndarray, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of one view at the smaller one's size.

    Raises FrameError when their shapes differ by more than rounding: such depth is not
    registered to the colour camera.
    """
    (rows, cols), (depth_rows, depth_cols) = image.shape[:2], depth.shape
    if abs(cols * depth_rows / (rows * depth_cols) - 1) > SAME_ASPECT:
        raise FrameError(
            f"{path}: depth of {depth.shape} is not registered to an image of {image.shape[:2]}"
        )
    if rows > depth_rows:
        image = cv2.resize(image, (depth_cols, depth_rows), interpolation=cv2.INTER_AREA)
    elif rows < depth_rows:
        depth = cv2.resize(depth, (cols, rows), interpolation=cv2.INTER_NEAREST)
    return image, depth


def read_colour(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """H x W x 3 uint8 RGB. Raises FrameError: unreadable, or not of the size (H, W).

    Pixels stay where they are stored, whatever EXIF says of the side that is up: depth and
    intrinsics are of these.
    """
    pixels = _decoded(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if size is not None and pixels.shape[:2] != size:
        raise FrameError(f"{path}: expected an image of {size}, got {pixels.shape[:2]}")
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def read_uint16(path: Path) -> np.ndarray:
    """H x W of a 16-bit grey PNG. Raises FrameError when it is none."""
    pixels = _decoded(path, cv2.IMREAD_UNCHANGED)
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise FrameError(f"{path}: expected a grey 16-bit PNG, got {pixels.dtype} {pixels.shape}")
    return pixels


def read_float16_png(path: Path) -> np.ndarray:
    """H x W float32 out of a PNG whose 16 bits are those of a float16."""
    return read_uint16(path).view(np.float16).astype(np.float32)


def read_exr(path: Path) -> np.ndarray:
    """H x W float32 of a one-channel OpenEXR file (or of the first of Y, Z, V, R).

    Raises FrameError: unreadable; DataError: the library is missing.
    """
    library: Any = needed("OpenEXR", path)
    try:
        with library.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            names = [name for name in EXR_CHANNELS if name in channels] or list(channels)
            return np.asarray(channels[names[0]].pixels).astype(np.float32)
    except Exception as error:  # the binding raises whatever C++ threw
        raise FrameError(f"{path}: no readable OpenEXR file: {error}") from error


def needed(module: str, path: Path) -> Any:
    """An optional library that reads `path`. Raises DataError naming how to install it."""
    try:
        return __import__(module)
    except ImportError as error:
        raise DataError(
            f"{path}: reading it needs {module}: pip install {module}, or "
            "this package's extra `datasets`"
        ) from error


def read_table(path: Path, columns: int) -> np.ndarray:
    """Lines of numbers -> N x columns float64. Raises FrameError naming file and expectation.

    A matrix of so many numbers may be written in as many lines as it has rows.
    """
    expected = f"{path}: expected lines of {columns} numbers"
    table = numbers(path, expected)
    if table.shape[1] == columns:
        return table
    if table.size == columns:
        return table.reshape(1, columns)
    raise FrameError(f"{expected}, got {len(table)} lines of {table.shape[1]}")


def numbers(path: Path, expected: str) -> np.ndarray:
    """Lines of equally many numbers, N x k float64. Raises FrameError, which begins as expected."""
    try:
        return np.loadtxt(path, dtype=np.float64, ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        told = told_by_head(path)
        raise FrameError(f"{expected}: {f'it is {told}' if told else error}") from error


def _decoded(path: Path, flags: int) -> np.ndarray:
    try:
        data = np.fromfile(path, np.uint8)
        pixels = cv2.imdecode(data, flags) if data.size else None
    except (OSError, cv2.error) as error:
        raise FrameError(f"{path}: cannot be read: {error}") from error
    if pixels is None:
        if told := told_by_head(path, "image"):
            raise FrameError(f"{path} is {told}")
        raise FrameError(f"{path}: no such image, or a damaged one")
    return pixels
