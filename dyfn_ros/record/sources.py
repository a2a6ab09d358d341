"""Frames that a recording can be made of: RGB-D folders of known layouts, and video files."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.rgbd.layouts import EXPECTED, PLAIN, FolderOptions, find_folders
from dyfn_ros.record.camera_yaml import CameraYaml
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_folder import open_rgbd, rgbd_frames
from dyfn_ros.recordings.rgbd_writer import FrameToRecord
from dyfn_ros.recordings.typestore import Lens

LEVELS = 2  # folders below the named one that are searched
Warn = Callable[[str], None]


def folder_frames(
    path: Path,
    warn: Warn,
    rate: float | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth_scale: float | None = None,
) -> Iterator[FrameToRecord]:
    """Frames of one RGB-D folder of a layout of dyfn_core.data.rgbd.

    Depth and colour of different sizes are brought to the smaller one, and frames without depth
    left out, except in the plain layout.

    Args:
        path: the folder, or one that holds one folder up to two levels below.
        warn: takes what is left out.
        rate: frames a second of folders without stamps; see rgbd_frames.
        intrinsics: fx, fy, cx, cy in pixels of the colour image, instead of the folder's own.
        depth_scale: stored depth values per metre, instead of the layout's.

    Raises:
        RecordingError: no such folder, several (listed), or one that cannot be read.
    """
    folder = open_rgbd(_one_folder(path), warn, FolderOptions(intrinsics, depth_scale))
    sensor = folder.layout != PLAIN
    if sensor and not folder.with_depth:
        raise RecordingError(f"{path}: no frames with depth; expected {EXPECTED}")
    for frame in rgbd_frames(folder, warn, rate, same_size=sensor):
        if frame.depth_m is not None or not sensor:
            yield frame


def _one_folder(path: Path) -> Path:
    found = list(find_folders(path, LEVELS))
    if not found:
        raise RecordingError(f"{path}: expected {EXPECTED}")
    if len(found) > 1:
        raise RecordingError(
            f"{path} holds several folders, name one of them: {', '.join(map(str, found))}"
        )
    return found[0]


def video_frames(
    path: Path,
    warn: Warn,
    matrix: np.ndarray | None = None,
    lens: Lens | None = None,
    camera: CameraYaml | None = None,
    rate: float | None = None,
) -> Iterator[FrameToRecord]:
    """Frames of a video file that OpenCV can decode, stamped with their own times from its start.

    Frames whose time does not rise are left out.

    Args:
        path: the video.
        warn: takes what is left out or missing at the end.
        matrix: 3 x 3 intrinsics in pixels of the frames as they are shown (turned upright).
        lens: their distortion.
        camera: both from a file, whose size must be the frames'.
        rate: frames a second, instead of the video's own times.

    Raises:
        RecordingError: no readable video, another size, no times and no rate.
    """
    if camera is not None:
        matrix, lens = camera.matrix, camera.lens
    video = cv2.VideoCapture(str(path))
    try:
        announced = round(video.get(cv2.CAP_PROP_FRAME_COUNT))
        decoded, last, late = 0, -math.inf, []
        while True:
            read, pixels = video.read()
            if not read:
                break
            if camera is not None and pixels.shape[:2] != camera.size:
                raise RecordingError(f"{path}: {_sizes(pixels, camera)}")
            own = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
            stamp = own if rate is None else decoded / rate
            decoded += 1
            if not stamp > last:
                late.append(f"frame {decoded - 1} at {stamp:g} s after {last:g} s")
                continue
            last = stamp
            image = np.ascontiguousarray(pixels[..., ::-1])
            yield FrameToRecord(image, None, matrix, None, stamp, lens)
    finally:
        video.release()
    if decoded == 0:
        raise RecordingError(f"{path}: expected a video file, no frame can be decoded")
    if late and len(late) == decoded - 1:
        raise RecordingError(
            f"{path}: holds no times of its {decoded} frames (a raw H.264 or H.265 stream has "
            "none); give --rate, or put it into a container such as .mp4"
        )
    if late:
        warn(f"{path}: {len(late)} frames whose time does not rise are left out ({late[0]})")
    if decoded < announced:
        warn(f"{path}: {decoded} of {announced} announced frames could be decoded")


def _sizes(pixels: np.ndarray, camera: CameraYaml) -> str:
    return (
        f"frames have {pixels.shape[1]} x {pixels.shape[0]} pixels, "
        f"but the calibration is for {camera.size[1]} x {camera.size[0]}"
    )
