"""The camera of `dyfn-depth`: given, by EXIF, or left to the model."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.data.frames import DataError
from dyfn_core.data.rgbd.cameras import read_camera
from dyfn_core.geometry.camera import check_camera_matrix, doubted_intrinsics
from dyfn_ros.depth.settings import Camera
from dyfn_ros.depth.source import SourceFrame
from dyfn_ros.messages.rectify import Rectifier, RectifyRules
from dyfn_ros.recordings.camera_yaml import CameraYaml, read_camera_yaml
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.image_recording import centred
from dyfn_ros.recordings.pictures import exif_focal
from dyfn_ros.recordings.typestore import camera_info

ESTIMATED = "estimated by the model"


class KnownCamera:
    """Gives each frame its intrinsics, and takes the distortion of a known lens out of it.

    Attributes:
        origin: Where the intrinsics of the last frame are from, for people.
    """

    def __init__(self, camera: Camera) -> None:
        """Read what was given.

        Raises:
            RecordingError, ValueError: A matrix or file that cannot be of a camera.
        """
        self.origin = ESTIMATED
        self._camera = camera
        self._matrix: np.ndarray | None = None
        self._calibration: CameraYaml | None = None
        if camera.matrix is not None:
            self._read(camera.matrix)
        self._warned: list[str] = []
        self._rectifier = Rectifier(self._warned.append)

    def _read(self, words: tuple[str, ...]) -> None:
        if len(words) == 1 and Path(words[0]).suffix.lower() in (".yaml", ".yml"):
            self._calibration = read_camera_yaml(Path(words[0]))
            self._matrix = self._calibration.matrix
            return
        try:
            if len(words) == 1:
                values = np.array(read_camera(Path(words[0])).pixels)
            else:
                values = np.array([float(word) for word in words])
        except (DataError, ValueError) as error:
            raise ValueError(f"--camera-matrix {' '.join(words)}: {error}") from error
        if len(values) == 4:
            fx, fy, cx, cy = values
            values = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
        if len(values) != 9:
            raise ValueError(f"--camera-matrix: expected 4 or 9 numbers, got {len(values)}")
        self._matrix = check_camera_matrix(values.reshape(3, 3))

    def apply(self, frame: SourceFrame) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
        """What the stream takes of a frame.

        Returns:
            The image without distortion, its intrinsics (3 x 3 pixels; None: unknown), and where
            the image shows something (H x W bool; None: everywhere).

        Raises:
            RecordingError: The calibration is for images of another size, or cannot be of these.
        """
        size = (frame.image.shape[0], frame.image.shape[1])
        matrix = self._matrix_of(frame, size)
        if matrix is None:
            return frame.image, None, None
        pixels = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
        if doubt := doubted_intrinsics(pixels, size):
            raise RecordingError(f"{self.origin}: {doubt}")
        if self._calibration is None or self._calibration.lens is None:
            return frame.image, matrix, None
        info: Any = camera_info(matrix, size, 0, "", self._calibration.lens)
        view = self._rectifier.view(frame.image, "", info, RectifyRules())
        if self._warned:
            raise RecordingError(f"{self.origin}: {self._warned[0]}")
        return view.image, view.matrix, view.visible

    def _matrix_of(self, frame: SourceFrame, size: tuple[int, int]) -> np.ndarray | None:
        height, width = size
        if self._camera.fov is not None:
            self.origin = f"--fov {self._camera.fov:g}"
            return centred(width / 2 / math.tan(math.radians(self._camera.fov) / 2), size)
        if self._matrix is not None:
            self.origin = f"--camera-matrix {' '.join(self._camera.matrix or ())}"
            if self._calibration is not None and self._calibration.size != size:
                wanted = "{1} x {0}".format(*self._calibration.size)
                raise RecordingError(
                    f"{self.origin}: frames have {width} x {height} pixels, but the calibration "
                    f"is for {wanted}"
                )
            return self._matrix
        if frame.camera_matrix is not None:
            self.origin = "the folder's own"
            return frame.camera_matrix
        if self._camera.exif and frame.file is not None:
            focal = exif_focal(frame.file, size)
            if focal is not None:
                self.origin = f"EXIF of {frame.file.name}"
                return centred(focal, size)
        self.origin = ESTIMATED
        return None
