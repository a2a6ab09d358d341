"""Pictures without depth: single files, and folders of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from dyfn_core.data.files import read_colour
from dyfn_core.data.frames import FrameError
from dyfn_core.data.rgbd.names import visible_files
from dyfn_ros.recordings.errors import RecordingError

PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".avif")
# Pictures that are meant and cannot be read.
UNDECODED = (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")
DIAGONAL_35MM = 43.2666  # mm of a 36 x 24 mm frame
# EXIF (CIPA DC-008): the IFD of the camera, and tags in it.
EXIF_IFD, FOCAL_MM, FOCAL_35MM = 0x8769, 0x920A, 0xA405
PLANE_X_RESOLUTION, PLANE_UNIT, PIXELS_X = 0xA20E, 0xA210, 0xA002
MM_OF_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
Lose = Callable[[str], None]


def is_picture_name(path: Path) -> bool:
    """Whether a file's name is that of a picture, also of one that cannot be read."""
    return path.suffix.lower() in PICTURE_SUFFIXES + UNDECODED


def pictures_in(folder: Path) -> list[Path]:
    """The pictures of a folder, without those of folders in it, by the numbers in their names."""
    return [path for path in visible_files(folder) if is_picture_name(path) and path.is_file()]


def read_picture(path: Path) -> np.ndarray:
    """H x W x 3 uint8 RGB, upright as EXIF has it. Raises RecordingError, naming the file."""
    if path.suffix.lower() in UNDECODED:
        known = ", ".join(PICTURE_SUFFIXES)
        raise RecordingError(f"{path}: {path.suffix} cannot be read, expected one of {known}")
    try:
        return read_colour(path)
    except FrameError as error:
        raise RecordingError(str(error)) from error


def pictures(paths: Sequence[Path], lose: Lose) -> Iterator[tuple[Path, np.ndarray]]:
    """Every picture that can be read, in this order; `lose` takes why another cannot."""
    for path in paths:
        try:
            image = read_picture(path)
        except RecordingError as error:
            lose(str(error))
            continue
        yield path, image


def exif_focal(path: Path, size: tuple[int, int]) -> float | None:
    """The focal length that a picture's EXIF gives, in pixels.

    By the equivalent of a 35 mm camera, which keeps the diagonal, also of a picture that was made
    smaller; else by the focal length and the resolution of the sensor, when the picture still has
    the size that it was taken with. A cropped picture does not say so.

    Args:
        path: of the picture.
        size: (H, W) in pixels.

    Returns:
        None when there is no EXIF or it has neither.
    """
    try:
        with Image.open(path) as picture:
            tags = picture.getexif().get_ifd(EXIF_IFD)
    except (OSError, ValueError, SyntaxError):
        return None
    height, width = size
    equivalent = _number(tags.get(FOCAL_35MM))
    if equivalent:
        return equivalent / DIAGONAL_35MM * float(np.hypot(height, width))
    focal, per_unit = _number(tags.get(FOCAL_MM)), _number(tags.get(PLANE_X_RESOLUTION))
    unit = MM_OF_UNIT.get(tags.get(PLANE_UNIT, 2))
    if focal and per_unit and unit and tags.get(PIXELS_X) in (width, height):
        return focal * per_unit / unit
    return None


def _number(value: object) -> float:
    """A positive tag, 0 for none: rationals of EXIF may be broken."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if 0 < number < float("inf") else 0.0
