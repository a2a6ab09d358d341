"""An RGB-D folder: its frames in the order of time, each with the files that belong to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from dyfn_core.data.files import read_colour, read_uint16, registered, rgbd_frame
from dyfn_core.data.frames import DataError, FrameError, RgbdFrame, camera_intrinsics
from dyfn_core.data.rgbd.cameras import Camera, FolderCamera, Size, laid_over, read_camera

NO_DEPTH = (0, 65535)  # stored values: none, and beyond what 16 bits can say


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame.

    Attributes:
        number: rises from frame to frame; a larger step than usual is a gap.
        image: the colour file.
        depth: the depth file; None without one.
        pose: 4 x 4 camera to world in metres, optical axes; None when unknown.
        stamp: seconds, where the folder has stamps.
    """

    number: int
    image: Path
    depth: Path | None
    pose: np.ndarray | None = None
    stamp: float | None = None


@dataclass(frozen=True)
class Calibration:
    """Where the intrinsics of a folder are: the first of these that is there.

    Attributes:
        given: by the user.
        file: camera matrix in the folder.
        published: of the sensor.
    """

    given: FolderCamera | None
    file: Path
    published: FolderCamera | None = None


@dataclass(frozen=True)
class RgbdFolder:
    """One folder whose layout is known; see rgbd.layouts.open_folder.

    Attributes:
        path: the folder.
        layout: one of rgbd.layouts.LAYOUTS.
        frames: in the order of time, those without depth as well.
        calibration: where the intrinsics are; they are read when they are asked for.
        unit: stored depth values per metre.
        depth_camera: intrinsics of the depth files, which are then laid over the images. With
            intrinsics that were given, or are in the folder, depth is taken to lie there already.
        doubts: what makes the pairs of images and depth implausible.
    """

    path: Path
    layout: str
    frames: tuple[FrameFiles, ...]
    calibration: Calibration
    unit: float
    depth_camera: FolderCamera | None = None
    doubts: tuple[str, ...] = ()

    @property
    def with_depth(self) -> list[FrameFiles]:
        """The frames that have a depth file."""
        return [frame for frame in self.frames if frame.depth is not None]

    @cached_property
    def camera(self) -> FolderCamera | None:
        """The intrinsics; None when the folder has none. Raises DataError for a wrong file."""
        known = self.calibration
        if known.given is not None:
            return known.given
        return read_camera(known.file) if known.file.exists() else known.published

    def check_camera(self, needed: bool = False) -> None:
        """Compare the intrinsics with the first image that can be read.

        Args:
            needed: whether a folder without intrinsics is an error.

        Raises:
            DataError: there are none, or they cannot be of these images.
        """
        if self.camera is None:
            if needed:
                raise DataError(
                    f"{self.calibration.file} is missing; give `intrinsics: [fx, fy, cx, cy]` in "
                    "pixels of the colour image"
                )
            return
        for frame in self.frames:
            try:
                size = _size(self.image(frame))
            except FrameError:
                continue
            try:
                self.camera.at(size)
            except FrameError as error:
                raise DataError(str(error)) from error
            return

    def camera_at(self, size: Size) -> Camera | None:
        """fx, fy, cx, cy in pixels of images of this size (rows, columns); None when unknown.

        Raises:
            FrameError: the intrinsics are of other images.
        """
        return None if self.camera is None else self.camera.at(size)

    def image(self, frame: FrameFiles) -> np.ndarray:
        """H x W x 3 uint8 RGB. Raises FrameError when it cannot be read."""
        return read_colour(frame.image)

    def depth(self, frame: FrameFiles) -> np.ndarray | None:
        """h x w float32 metres over the image, NaN invalid; None without a file.

        Raises:
            FrameError: it cannot be read, or the intrinsics are of other images.
        """
        if frame.depth is None:
            return None
        stored = read_uint16(frame.depth)
        metres: np.ndarray = stored.astype(np.float32) / np.float32(self.unit)
        metres[np.isin(stored, NO_DEPTH)] = np.nan
        published = self.calibration.published
        if self.depth_camera is None or published is None or self.camera is not published:
            return metres
        size = _size(metres)
        return laid_over(metres, self.depth_camera.at(size), published.at(size))

    def registered(self, frame: FrameFiles) -> tuple[np.ndarray, np.ndarray]:
        """Image and depth at the smaller one's size. Raises FrameError, also without depth."""
        image, depth = self.image(frame), self.depth(frame)
        if depth is None or frame.depth is None:
            raise FrameError(f"{frame.image}: has no depth")
        return registered(image, depth, frame.depth)

    def pairs(self, stride: int = 1) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Image and depth of every stride-th frame with depth, as registered gives them."""
        return (self.registered(frame) for frame in self.with_depth[::stride])

    def read(self, frame: FrameFiles) -> RgbdFrame:
        """A frame with depth and intrinsics. Raises FrameError when a part cannot be used."""
        image, depth = self.image(frame), self.depth(frame)
        size = _size(image)
        camera = self.camera_at(size)
        if depth is None or frame.depth is None or camera is None:
            raise FrameError(f"{frame.image}: has no {'intrinsics' if camera is None else 'depth'}")
        intrinsics = camera_intrinsics(*camera, size, frame.image)
        image, depth = registered(image, depth, frame.depth)
        found = rgbd_frame(image, depth, intrinsics, frame.pose, frame.depth)
        return replace(found, stamp=frame.stamp)


def _size(image: np.ndarray) -> Size:
    return (image.shape[0], image.shape[1])
