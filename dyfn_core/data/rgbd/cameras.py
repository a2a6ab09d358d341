"""Intrinsics of RGB-D folders: K.txt, published calibrations, and whether they fit an image."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dyfn_core.data.files import SAME_ASPECT
from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.data.heads import told_by_head
from dyfn_core.geometry.camera import doubted_intrinsics

Camera = tuple[float, float, float, float]  # fx, fy, cx, cy in pixels, the first pixel's centre 0
Size = tuple[int, int]  # rows, columns
SKEW = 1e-3  # relative to fx; more is refused
EXPECTED = (
    "a 3 x 3 (or 3 x 4, 4 x 4) camera matrix [fx 0 cx; 0 fy cy; 0 0 1], or fx fy cx cy, in pixels"
)
# The published calibrations of cameras whose folders come without one, of 640 x 480 pixels.
TUM_CAMERAS: dict[str, Camera] = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
    "bonn": (542.822841, 542.576870, 315.593520, 237.756098),
}
# 7-Scenes publishes 585, which is the depth camera's; its depth is not laid over the colour image.
SEVEN_SCENES_CAMERA: Camera = (525.0, 525.0, 320.0, 240.0)
SEVEN_SCENES_DEPTH: Camera = (585.0, 585.0, 320.0, 240.0)
PUBLISHED_SIZE: Size = (480, 640)


@dataclass(frozen=True)
class FolderCamera:
    """Intrinsics of one folder.

    Attributes:
        pixels: fx, fy, cx, cy.
        source: where they are from, for messages.
        size: of the images that they were measured on; None when they are of these images.
    """

    pixels: Camera
    source: str
    size: Size | None = None

    def at(self, size: Size) -> Camera:
        """Intrinsics for images of this size.

        Raises:
            FrameError: they are of images of another shape, or cannot be of these images: the
                principal point outside, or a focal length that is no tenth to ten times the width.
        """
        (height, width), (fx, fy, cx, cy) = size, self.pixels
        if self.size is not None and self.size != size:
            rows, columns = self.size
            if abs(width * rows / (height * columns) - 1) > SAME_ASPECT:
                raise FrameError(
                    f"{self.source}: of {columns} x {rows} pixels, but the images have {width} x "
                    f"{height}"
                )
            x, y = width / columns, height / rows
            fx, fy, cx, cy = fx * x, fy * y, (cx + 0.5) * x - 0.5, (cy + 0.5) * y - 0.5
        doubted = doubted_intrinsics((fx, fy, cx, cy), size)
        if doubted:
            raise FrameError(f"{self.source}: {doubted}")
        return fx, fy, cx, cy


@dataclass(frozen=True)
class SensorInfo:
    """What the info.txt beside frames that were exported from a .sens file says.

    Attributes:
        camera: of the colour images.
        unit: stored depth values per metre.
    """

    camera: FolderCamera
    unit: float

    @classmethod
    def read(cls, path: Path) -> SensorInfo | None:
        """Lines `m_name = value`.

        Returns:
            None of a file that says something else.

        Raises:
            DataError: it cannot be read, or a value is not what was expected.
        """
        try:
            lines = (line.split("=", 1) for line in path.read_text("utf-8-sig").splitlines())
            held = {pair[0].strip(): pair[1].split() for pair in lines if len(pair) == 2}
        except (OSError, UnicodeDecodeError) as error:
            raise DataError(f"{path}: cannot be read: {error}") from error

        if not any(key.startswith("m_") for key in held):
            return None

        def numbers(key: str, count: int) -> list[float]:
            try:
                found = [float(word) for word in held[key]]
            except (KeyError, ValueError):
                found = []
            if len(found) != count:
                raise DataError(f"{path}: expected {key} = {count} numbers, got {held.get(key)}")
            return found

        matrix = np.array(numbers("m_calibrationColorIntrinsic", 16)).reshape(4, 4)[:3, :3]
        (width,), (height,) = numbers("m_colorWidth", 1), numbers("m_colorHeight", 1)
        (unit,) = numbers("m_depthShift", 1)
        if not (unit > 0 and width >= 1 and height >= 1):
            raise DataError(f"{path}: expected sizes and m_depthShift above 0")
        size = (int(height), int(width))
        return cls(FolderCamera(_checked(matrix, path), str(path), size), unit)


def published_camera(folder: Path) -> FolderCamera | None:
    """Of a TUM or Bonn sequence, by its path; None when the path names none."""
    named = str(folder.resolve()).lower()
    known = [name for name in TUM_CAMERAS if name in named]
    if not known:
        return None
    source = f"published intrinsics of {known[-1]}"
    return FolderCamera(TUM_CAMERAS[known[-1]], source, PUBLISHED_SIZE)


def laid_over(depth: np.ndarray, depth_camera: Camera, camera: Camera) -> np.ndarray:
    """Depth of one camera as another one at the same place sees it, by the nearest pixel.

    Args:
        depth: H x W.
        depth_camera: intrinsics of it.
        camera: of the result, in pixels of the same size.

    Returns:
        H x W; NaN outside the view of depth.
    """
    height, width = depth.shape
    (fx, fy, cx, cy), (gx, gy, dx, dy) = depth_camera, camera
    columns = np.rint(cx + (np.arange(width) - dx) * fx / gx).astype(int)
    rows = np.rint(cy + (np.arange(height) - dy) * fy / gy).astype(int)
    inside = (rows >= 0) & (rows < height)
    inside = inside[:, None] & ((columns >= 0) & (columns < width))[None]
    found = depth[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)[None]]
    return np.asarray(np.where(inside, found, np.float32(np.nan)))


def read_camera(path: Path) -> FolderCamera:
    """A camera matrix out of a text file.

    Raises:
        DataError: the file holds something else, or a matrix that no camera has.
    """
    try:
        lines = (line.split("#")[0] for line in path.read_text("utf-8-sig").splitlines())
        words = (word for line in lines for word in re.split(r"[\s,;\[\]]+", line) if word)
        values = [float(word) for word in words]
    except (OSError, ValueError) as error:
        told = told_by_head(path)
        why = f"it is {told}" if told else error
        raise DataError(f"{path}: expected {EXPECTED}: {why}") from error
    shapes = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
    if len(values) == 4:
        fx, fy, cx, cy = values
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    elif len(values) in shapes:
        matrix = np.array(values).reshape(shapes[len(values)])[:3, :3]
    else:
        raise DataError(f"{path}: expected {EXPECTED}, got {len(values)} numbers")
    return FolderCamera(_checked(matrix, path), str(path))


def _checked(matrix: np.ndarray, path: Path) -> Camera:
    told = f"got {matrix.tolist()}"
    fx, fy = float(matrix[0, 0]), float(matrix[1, 1])
    if not np.isfinite(matrix).all() or not (fx > 0 and fy > 0):
        raise DataError(f"{path}: expected finite numbers and focal lengths above 0, {told}")
    if not np.array_equal(matrix[2], [0, 0, 1]):
        turned = " (it is transposed)" if np.array_equal(matrix[:, 2], [0, 0, 1]) else ""
        raise DataError(f"{path}: expected the last row 0 0 1{turned}, {told}")
    if max(abs(matrix[0, 1]), abs(matrix[1, 0])) > SKEW * fx:
        raise DataError(f"{path}: expected a camera matrix without skew, {told}")
    return fx, fy, float(matrix[0, 2]), float(matrix[1, 2])
