"""Messages of a depth topic -> the true depth of the image's pixels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dyfn_core.geometry.camera import normalize_intrinsics
from dyfn_core.geometry.projection import back_project, render_depth, resized_camera
from dyfn_core.prediction import DEPTH, DISPARITY
from dyfn_core.quantities import scored_values
from dyfn_ros.messages.camera_info import CameraCalibration, decode_camera_info
from dyfn_ros.messages.compressed_depth import decode_compressed_depth
from dyfn_ros.messages.encodings import MessageError
from dyfn_ros.messages.images import decode_depth
from dyfn_ros.messages.rectify import PinholeImage, is_rectified, undistort_depth
from dyfn_ros.messages.references import Transform, decode_points
from dyfn_ros.recordings.storage.base import Recorded
from dyfn_ros.recordings.typestore import COMPRESSED_IMAGE, POINT_CLOUD

SAME = 2e-3  # of the image's width and height: intrinsics that differ by less are the same


class GroundTruth:
    """Decodes one depth or point cloud topic.

    transform: pose of its sensor in the image's optical frame; None: the image's own place.
    warn: takes what had to be assumed. quantity: what its images hold, one of
    quantities.QUANTITIES; inverse depth is inverted, disparity stays what it is. scale: stored
    values per metre; None: 1000 for integers, 1 for floats and points.

    A depth image without CameraInfo, or with the intrinsics and lens of the image, is registered
    already: it shows the image's view, at any resolution. Any other is projected into the image.
    """

    def __init__(
        self,
        transform: Transform | None,
        warn: Callable[[str], None],
        quantity: str = DEPTH,
        scale: float | None = None,
    ) -> None:
        self._transform = transform
        self._scale = scale
        self._warn = warn
        self._quantity = quantity

    def decode(
        self, recorded: Recorded, info: Any, view: PinholeImage, frame_id: str
    ) -> np.ndarray:
        """H x W float32 metres along the optical axis of the view, NaN where there is none.

        info: CameraInfo of the depth image, or None. view, frame_id: the image's. The result has
        the view's aspect ratio when it was projected, see register_depth.
        Raises MessageError when the message is no depth, intrinsics that are needed are absent, or
        disparity, whose points are not known, would have to be projected.
        """
        message = recorded.message()
        if recorded.kind == POINT_CLOUD:
            return self._cloud(message, view, frame_id)
        depth = self._image(message, recorded.kind == COMPRESSED_IMAGE)
        calibration = self._calibration(info, depth, is_rectified(recorded.topic))
        if self._transform is not None and (calibration is None or view.matrix is None):
            raise MessageError("a transform needs the intrinsics of the image and of the depth")
        if calibration is None or view.matrix is None:
            self._check_registered(message, info, frame_id)
            return undistort_depth(depth, view)
        if self._transform is None and _same_camera(calibration, depth, view):
            return undistort_depth(depth, view)
        if self._quantity == DISPARITY:
            raise MessageError(
                "disparity of another camera than the image's (by its CameraInfo) cannot be "
                "projected into the image; register it before it is recorded"
            )
        self._check_place(message, frame_id, "at the image's optical centre")
        if calibration.distorted:
            lens = PinholeImage(np.empty((*depth.shape, 0)), calibration.matrix, lens=calibration)
            depth = undistort_depth(depth, lens)
        size = (view.image.shape[0], view.image.shape[1])
        return register_depth(depth, calibration.matrix, view.matrix, size, self._transform)

    def _image(self, message: Any, compressed: bool) -> np.ndarray:
        full = self._quantity != DEPTH
        if compressed:
            stored = decode_compressed_depth(message, self._scale, full=full)
            return scored_values(stored, self._quantity)
        zero = self._quantity == DISPARITY
        stored = decode_depth(message, zero=zero, full=full, scale=self._scale)
        return scored_values(stored, self._quantity)

    def _cloud(self, message: Any, view: PinholeImage, frame_id: str) -> np.ndarray:
        if view.matrix is None:
            raise MessageError("a point cloud needs the intrinsics of the image")
        points = decode_points(message) / (self._scale or 1.0)
        self._check_place(message, frame_id, "at the image's optical centre, z forward")
        if self._transform is not None:
            points = self._transform(points)
        return render_depth(points, view.matrix, (view.image.shape[0], view.image.shape[1]))

    def _calibration(
        self, info: Any, depth: np.ndarray, rectified: bool
    ) -> CameraCalibration | None:
        if info is None:
            return None
        try:
            return decode_camera_info(info, *depth.shape, rectified=rectified)
        except MessageError as error:
            self._warn(f"its CameraInfo {error}; taken as registered to the image")
            return None

    def _check_registered(self, message: Any, info: Any, frame_id: str) -> None:
        """Frames that are numbers, as the RealSense SDK counts them, say nothing."""
        own, images = (name.lstrip("/") for name in (str(message.header.frame_id), frame_id))
        if own and images and own != images and not (own.isdigit() and images.isdigit()):
            lacking = "the image has no usable intrinsics" if info else "it has no CameraInfo"
            self._warn(f"frame {own!r} taken as registered to the image ({images!r}): {lacking}")

    def _check_place(self, message: Any, frame_id: str, assumed: str) -> None:
        own = str(message.header.frame_id)
        if self._transform is None and own.lstrip("/") != frame_id.lstrip("/"):
            self._warn(f"frame {own!r} taken to be {assumed} ({frame_id!r}): no transform given")


def _same_camera(calibration: CameraCalibration, depth: np.ndarray, view: PinholeImage) -> bool:
    """Whether depth and image are of one camera, but for the resolution."""
    assert view.matrix is not None
    ours = normalize_intrinsics(view.matrix, (view.image.shape[0], view.image.shape[1]))
    theirs = normalize_intrinsics(calibration.matrix, (depth.shape[0], depth.shape[1]))
    lens = view.lens or CameraCalibration(view.matrix)
    if lens.distorted != calibration.distorted:
        return False
    same_lens = not lens.distorted or (lens.model, lens.d) == (calibration.model, calibration.d)
    return same_lens and bool(np.abs(ours - theirs).max() < SAME)


def register_depth(
    depth: np.ndarray,
    depth_matrix: np.ndarray,
    matrix: np.ndarray,
    size: tuple[int, int],
    transform: Transform | None = None,
) -> np.ndarray:
    """Depth of one pinhole camera as another one sees it, the nearest surface in each pixel.

    depth: h x w metres, NaN invalid; depth_matrix: its 3 x 3 intrinsics, pixels.
    matrix, size: of the other camera, (H, W). transform: from the depth camera's optical frame
    to the other's; None: they share one. Returns float32 with the view of H x W, at no higher
    a resolution than depth has, so that neighbouring pixels of depth leave no gaps in it.
    """
    points = back_project(depth, depth_matrix)
    if transform is not None:
        points = transform(points)
    finer = max(matrix[0, 0] / depth_matrix[0, 0], matrix[1, 1] / depth_matrix[1, 1], 1.0)
    small = (max(round(size[0] / finer), 1), max(round(size[1] / finer), 1))
    return render_depth(points, resized_camera(matrix, size, small), small)
