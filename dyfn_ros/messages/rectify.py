"""What a CameraInfo does to an image: intrinsics, and the lens taken out."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from dyfn_ros.messages.camera_info import CameraCalibration, decode_camera_info
from dyfn_ros.messages.compressed_image import TRANSPORTS
from dyfn_ros.messages.encodings import MessageError, quoted

_RECTIFIED = re.compile(r"(?:^|_)rect(?:ified)?(?:_|$)")
_LEAST_VISIBLE = 0.1  # share of an undistorted image's pixels


def is_rectified(topic: str) -> bool:
    """Whether images are rectified by their topic's name, as image_proc gives it: P of their
    CameraInfo describes them, and K and D the images that they were made of."""
    parts = TRANSPORTS.sub("", topic).lower().rsplit("/", 2)
    return any(_RECTIFIED.search(part) for part in parts[-2:])


class LensError(MessageError):
    """A lens model that cannot be undone."""


@dataclass(frozen=True)
class PinholeImage:
    """An image as a pinhole camera sees it.

    image: H x W x 3 uint8 RGB. matrix: 3 x 3 float64 pixels, None when unknown.
    visible: H x W bool, False where undistortion had no pixel to take; None: all visible.
    info: the CameraInfo that describes the image as it is now; None when there is none.
    lens: what was undone; None when nothing was.
    """

    image: np.ndarray
    matrix: np.ndarray | None = None
    visible: np.ndarray | None = None
    info: Any = None
    lens: CameraCalibration | None = None


@dataclass(frozen=True)
class RectifyRules:
    """See the node's parameters of the same names."""

    rectified: bool = False
    distortion: str = "undistort"
    check_frame_id: bool = True


class Rectifier:
    """Applies CameraInfos to the images of one camera; keeps the last undistortion.

    warn: takes the reason when a CameraInfo is not used. Not for several threads at once.
    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self._warn = warn
        self._key: tuple[Any, ...] | None = None
        self._maps: tuple[np.ndarray, np.ndarray, np.ndarray]
        self._shown = 1.0  # share of the undistorted image

    def view(
        self, image: np.ndarray, frame_id: str, info: Any, rules: RectifyRules
    ) -> PinholeImage:
        """info: sensor_msgs/CameraInfo, or None.

        Raises MessageError when the lens is distorted and that is refused. An unusable info, also
        one of a lens that cannot be undone, costs the intrinsics only, and a warning.
        """
        if info is None:
            return PinholeImage(image)
        try:
            if rules.check_frame_id:
                _check_frame_id(frame_id, str(info.header.frame_id))
            height, width = image.shape[:2]
            calibration = decode_camera_info(info, height, width, rectified=rules.rectified)
        except MessageError as error:
            self._warn(f"{error}; going on without intrinsics")
            return PinholeImage(image)
        if not calibration.distorted or rules.distortion == "ignore":
            if calibration.distorted:
                self._warn("the lens is distorted (D is not 0), which is ignored")
            return PinholeImage(image, calibration.matrix, info=info)
        if rules.distortion == "refuse":
            raise MessageError(
                "the lens is distorted (D is not 0) and parameter distortion is refuse"
            )
        try:
            flat = self._undistorted(image, calibration)
        except LensError as error:
            self._warn(f"{error}; going on without intrinsics")
            return PinholeImage(image)
        if self._shown < _LEAST_VISIBLE:
            self._warn(
                f"D {list(calibration.d)} of no real lens: {self._shown:.1%} of the "
                "undistorted image would show something; going on without intrinsics"
            )
            return PinholeImage(image)
        return flat

    def _undistorted(self, image: np.ndarray, calibration: CameraCalibration) -> PinholeImage:
        key = (*calibration.matrix.reshape(-1), calibration.model, *calibration.d, *image.shape)
        if key != self._key:
            self._maps = undistortion(calibration, image.shape[0], image.shape[1])
            self._shown = float(self._maps[2].mean())
            self._key = key
        columns, rows, visible = self._maps
        flat = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return PinholeImage(flat, calibration.matrix, visible, lens=calibration)


def undistort_depth(depth: np.ndarray, view: PinholeImage) -> np.ndarray:
    """Depth registered with the image that a view was made from -> with the view.

    depth: H' x W' float32 of the same field of view, NaN invalid; each pixel takes its nearest.
    """
    if view.lens is None:
        return depth
    height, width = depth.shape
    scale = np.array([[width / view.image.shape[1]], [height / view.image.shape[0]], [1.0]])
    matrix = view.lens.matrix * scale
    matrix[:2, 2] += (scale[:2, 0] - 1) / 2  # pixel centres: c' = s (c + 1/2) - 1/2
    columns, rows, _ = undistortion(replace(view.lens, matrix=matrix), height, width)
    return cv2.remap(
        depth,
        columns,
        rows,
        cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )


def _check_frame_id(image: str, info: str) -> None:
    # tf1 wrote names with a slash in front.
    if image and info and image.lstrip("/") != info.lstrip("/"):
        raise MessageError(f"frame_id is {info!r}, but the images have {image!r}")


def undistortion(
    calibration: CameraCalibration, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Maps to the pinhole image with the same K: two H x W float32 (columns and rows of the
    source pixels), and H x W bool where those are inside the image.

    Raises LensError for an unknown lens model.
    """
    matrix, d = calibration.matrix, np.asarray(calibration.d, np.float64)
    size = (width, height)
    if calibration.model in ("plumb_bob", "rational_polynomial") and d.size in (4, 5, 8, 12, 14):
        maps = cv2.initUndistortRectifyMap(matrix, d, np.eye(3), matrix, size, cv2.CV_32FC1)
    elif calibration.model == "equidistant" and d.size == 4:
        maps = cv2.fisheye.initUndistortRectifyMap(matrix, d, np.eye(3), matrix, size, cv2.CV_32FC1)
    else:
        raise LensError(
            f"the lens model {quoted(calibration.model)} with {d.size} coefficients cannot be "
            "undone; known: plumb_bob (radtan), rational_polynomial, equidistant (kannala_brandt, "
            "fisheye)"
        )
    columns, rows = maps
    inside = (columns >= -0.5) & (columns <= width - 0.5) & (rows >= -0.5) & (rows <= height - 0.5)
    return columns, rows, inside
