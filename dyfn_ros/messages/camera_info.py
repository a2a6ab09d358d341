"""sensor_msgs/CameraInfo to intrinsics and back."""

from __future__ import annotations

import copy
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from dyfn_ros.messages.encodings import MessageError


@dataclass(frozen=True)
class CameraCalibration:
    """What a CameraInfo says about one image.

    matrix: 3 x 3 float64, pixels of the image at hand (binning and region of interest applied).
    model: name of the lens model, see lens_model. d: its coefficients; empty for rectified images.
    """

    matrix: np.ndarray
    model: str = ""
    d: tuple[float, ...] = ()

    @property
    def distorted(self) -> bool:
        """Whether the lens model is more than a pinhole."""
        return any(self.d)


def _window(info: Any) -> tuple[int, int, int, int]:
    """x, y, width, height of the image on the full sensor, before binning."""
    roi = info.roi
    if roi.width and roi.height:
        return int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)
    return 0, 0, int(info.width), int(info.height)


def decode_camera_info(
    info: Any, height: int, width: int, *, rectified: bool = False
) -> CameraCalibration:
    """sensor_msgs/CameraInfo -> the intrinsics of an image of height x width pixels.

    rectified: take P, which describes rectified images, instead of K and D; K where P is empty
    and D too.
    Raises MessageError: uncalibrated (K[0] == 0), no pinhole matrix, one of no real camera, D that
    is not finite, another size than the image.
    """
    k = _field(info, "k")
    matrix = np.array(k, np.float64).reshape(3, 3)
    if rectified and (any(_field(info, "p")) or any(_field(info, "d"))):
        matrix = np.array(_field(info, "p"), np.float64).reshape(3, 4)[:, :3].copy()
    if matrix[0, 0] == 0:
        raise MessageError(f"uncalibrated: {'P' if rectified else 'K'}[0] is 0")
    pinhole = [[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]]
    usable = np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0
    if not usable or not np.array_equal(matrix, pinhole):
        raise MessageError(f"no pinhole camera matrix [fx 0 cx; 0 fy cy; 0 0 1]: {matrix.tolist()}")
    x, y, w, h = _window(info)
    bin_x, bin_y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    if (h // bin_y, w // bin_x) != (height, width):
        raise MessageError(
            f"is for {w // bin_x} x {h // bin_y} pixels, but the images have {width} x {height}"
        )
    matrix[0, 2] = (matrix[0, 2] - x + 0.5) / bin_x - 0.5
    matrix[1, 2] = (matrix[1, 2] - y + 0.5) / bin_y - 0.5
    matrix[0, :2] /= bin_x
    matrix[1, 1] /= bin_y
    _check_plausible(matrix, height, width)
    d = () if rectified else tuple(float(value) for value in _field(info, "d"))
    if not np.isfinite(d).all():
        raise MessageError(f"D has values that are no finite numbers: {list(d)}")
    return CameraCalibration(matrix, lens_model(str(info.distortion_model)), d)


def _check_plausible(matrix: np.ndarray, height: int, width: int) -> None:
    """The bounds leave room for every lens, and for crops far off the centre."""
    size = max(height, width)
    focals, centre = matrix[[0, 1], [0, 1]], matrix[:2, 2] / (width, height)
    if not ((focals > 0.01 * size) & (focals < 1000 * size)).all():
        raise MessageError(
            f"focal lengths {focals.tolist()} of no real camera of {width} x {height} pixels, "
            f"expected {0.01 * size:g} to {1000 * size:g}"
        )
    if not (abs(centre - 0.5) < 100).all():
        raise MessageError(f"a principal point {matrix[:2, 2].tolist()} of no real camera")


# Other names of models that ROS knows; compared in lower case, words joined by _.
_MODELS = {
    "radtan": "plumb_bob",
    "radial_tangential": "plumb_bob",
    "kannala_brandt": "equidistant",
    "kannala_brandt4": "equidistant",
    "equi": "equidistant",
    "fisheye": "equidistant",
}


def lens_model(name: str) -> str:
    """The name that ROS has for a lens model; unknown names stay."""
    return _MODELS.get(re.sub(r"[\s/-]+", "_", name.strip().lower()), name)


def _field(info: Any, name: str) -> Any:
    """ROS 2 says k and p, ROS 1 recordings say K and P."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def resized_matrix(matrix: np.ndarray, scale: tuple[float, float]) -> np.ndarray:
    """3 x 3 or 3 x 4 camera matrix of the same view in other pixels.

    scale: new width over old width, and the same of the heights. A pixel's centre c, counted from
    the first one's, is at s (c + 1/2) - 1/2.
    """
    found = np.array(matrix, np.float64)
    for row, factor in enumerate(scale):
        found[row] *= factor
        found[row, 2] += (factor - 1) / 2
    return found


def resized_camera_info(info: Any, height: int, width: int) -> Any:
    """A sensor_msgs.msg.CameraInfo for an image of the same view with other pixels.

    Its binning and region of interest are worked into K and P, whose P[3] is in pixels too.
    """
    x, y, w, h = _window(info)
    scale = (width / w, height / h)
    found = copy.copy(info)
    found.roi = type(info.roi)()
    found.height, found.width, found.binning_x, found.binning_y = height, width, 0, 0
    for name, columns in (("k", 3), ("p", 4)):
        matrix = np.array(_field(info, name), np.float64).reshape(3, columns)
        matrix[:2, 2] -= (x, y)
        setattr(found, name, resized_matrix(matrix, scale).reshape(-1))
    return found


def camera_info_message(header: Any, matrix: np.ndarray, height: int, width: int) -> Any:
    """A pinhole camera of height x width pixels -> sensor_msgs.msg.CameraInfo.

    matrix: 3 x 3, pixels.
    """
    from sensor_msgs.msg import CameraInfo

    k = np.asarray(matrix, np.float64)
    return CameraInfo(
        header=header,
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=k.reshape(-1).tolist(),
        r=np.eye(3).reshape(-1).tolist(),
        p=np.column_stack([k, np.zeros(3)]).reshape(-1).tolist(),
    )
