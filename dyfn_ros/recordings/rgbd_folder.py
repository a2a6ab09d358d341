"""An RGB-D folder (rgb/, depth/, K.txt, poses.txt) read as a sequence of frames."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_writer import FrameToRecord

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png"}


def is_rgbd_folder(path: Path) -> bool:
    """Whether the folder holds rgb/ and no recording."""
    return (path / "rgb").is_dir() and not (path / "metadata.yaml").exists()


def numbered(folder: Path, suffixes: set[str]) -> list[Path]:
    """Image files of a folder in numeric order of their names (9 before 10)."""
    files = (f for f in folder.iterdir() if f.suffix.lower() in suffixes)
    return sorted(files, key=lambda f: ([int(n) for n in re.findall(r"\d+", f.stem)], f.name))


def read_rgbd_folder(
    path: str | Path, rate: float = 10.0, lose: Callable[[str], None] | None = None
) -> Iterator[FrameToRecord]:
    """Frames of `rgb/*.jpg|png` with `depth/<same name>.png`, stamped 0, 1/rate, 2/rate ...

    depth: uint16 millimetres, 0 = none. `K.txt`: 3 x 3 intrinsics in pixels. `poses.txt`: a
    row-major 4 x 4 camera-to-world matrix a line, one per colour frame. All three are optional.
    lose: takes what is wrong with a picture, which is then left out; the stamps stay.
    Raises RecordingError naming the file that is missing, unreadable or of the wrong shape.
    """
    folder = Path(path)
    files = numbered(folder / "rgb", IMAGE_SUFFIXES) if (folder / "rgb").is_dir() else []
    if not files:
        raise RecordingError(f"{folder}: expected colour images (jpg or png) in {folder / 'rgb'}")
    camera_matrix = _matrix(folder / "K.txt", (3, 3))
    poses = _matrix(folder / "poses.txt", (len(files), 4, 4))
    for index, file in enumerate(files):
        image = _attempt(_colour, file, lose)
        if image is None:
            continue
        yield FrameToRecord(
            image=image,
            depth_m=_attempt(_depth, folder / "depth" / f"{file.stem}.png", lose),
            camera_matrix=camera_matrix,
            pose=None if poses is None else poses[index],
            stamp=index / rate,
        )


def read_poses(folder: Path) -> np.ndarray | None:
    """N x 4 x 4 camera to world, one per colour frame; None without `poses.txt`.

    Raises RecordingError when it has another number of rows than there are colour images.
    """
    return _matrix(folder / "poses.txt", (len(numbered(folder / "rgb", IMAGE_SUFFIXES)), 4, 4))


def _attempt(
    read: Callable[[Path], np.ndarray | None], file: Path, lose: Callable[[str], None] | None
) -> np.ndarray | None:
    try:
        return read(file)
    except RecordingError as error:
        if lose is None:
            raise
        lose(str(error))
        return None


def _matrix(file: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    if not file.exists():
        return None
    try:
        return np.loadtxt(file, dtype=np.float64).reshape(shape)
    except ValueError as error:
        raise RecordingError(f"{file}: expected numbers of shape {shape}: {error}") from error


def _colour(file: Path) -> np.ndarray:
    pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if pixels is None:
        raise RecordingError(f"{file}: expected a colour image, cannot decode it")
    return np.ascontiguousarray(pixels[..., ::-1])


def _depth(file: Path) -> np.ndarray | None:
    if not file.exists():
        return None
    pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        found = "an unreadable file" if pixels is None else f"{pixels.dtype} {pixels.shape}"
        raise RecordingError(f"{file}: expected a 16-bit one-channel PNG in mm, found {found}")
    metres = pixels.astype(np.float32) / 1000
    return np.where(pixels > 0, metres, np.float32(np.nan))
