"""Frames that a recording can be made of: RGB-D folders of known layouts, and video files."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.datasets import rgbd_folder as layouts
from dyfn_core.data.frames import DataError, DataReport, FrameError, NumberedSequence
from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_ros.record.camera_yaml import CameraYaml
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder, read_rgbd_folder
from dyfn_ros.recordings.rgbd_writer import FrameToRecord
from dyfn_ros.recordings.typestore import Lens

PLAIN_RATE, SENSOR_RATE = 10.0, 30.0  # frames a second of folders without stamps
Warn = Callable[[str], None]


def folder_frames(
    path: Path,
    warn: Warn,
    rate: float | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    depth_scale: float | None = None,
) -> Iterator[FrameToRecord]:
    """Frames of one RGB-D folder: rgb/, depth/, K.txt; TUM; 7-Scenes; a ScanNet export.

    Stamps: TUM's own; else the frames' numbers over `rate` a second (10 for the plain layout,
    whose frames are counted, 30 for the others). intrinsics, depth_scale: see open_rgbd_folder;
    depth and colour of different sizes are brought to the smaller. warn: takes what is left out.
    Raises RecordingError: another layout, several folders (listed), a frame that cannot be read.
    """
    plain = is_rgbd_folder(path) and not (path / "rgb.txt").exists()
    if plain and intrinsics is None and depth_scale is None:
        yield from read_rgbd_folder(path, rate or PLAIN_RATE)
        return
    sequence = _one_sequence(path, warn, intrinsics, depth_scale)
    rate = rate or (PLAIN_RATE if plain else SENSOR_RATE)
    first = sequence.numbers[0]
    for index, number in enumerate(sequence.numbers):
        try:
            frame = sequence.read(index)
        except FrameError as error:
            warn(f"frame left out: {error}")
            continue
        fx, fy, cx, cy = (float(value) for value in frame.intrinsics)
        normalised = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        matrix = pixel_intrinsics(normalised, frame.image.shape[:2])
        stamp = (number - first) / rate if frame.stamp is None else frame.stamp
        yield FrameToRecord(frame.image, frame.depth, matrix, frame.pose, stamp)


def _one_sequence(
    path: Path,
    warn: Warn,
    intrinsics: tuple[float, float, float, float] | None,
    depth_scale: float | None,
) -> NumberedSequence:
    report = DataReport(str(path))
    try:
        found = layouts.open_rgbd_folder(
            path,
            report,
            intrinsics=intrinsics,
            depth_scale=depth_scale,
            max_gap=sys.float_info.max,  # a gap is no cut here: the stamps tell of it
            max_missing=10**9,
        )
    except (DataError, FrameError) as error:
        raise RecordingError(str(error)) from error
    usable = [one for one in found if isinstance(one, NumberedSequence) and len(one)]
    if not usable:
        raise RecordingError(f"{path}: no frames with depth; expected {layouts.EXPECTED}")
    if len(usable) > 1:
        names = ", ".join(one.name for one in usable)
        raise RecordingError(f"{path} holds several folders, name one of them: {names}")
    for reason, names_of in report.problems.items():
        warn(f"{len(names_of)} x {reason} ({names_of[0]}{', ...' if names_of[1:] else ''})")
    return usable[0]


def video_frames(
    path: Path,
    warn: Warn,
    matrix: np.ndarray | None = None,
    lens: Lens | None = None,
    camera: CameraYaml | None = None,
) -> Iterator[FrameToRecord]:
    """Frames of a video file that OpenCV can decode, stamped with their own times from its start.

    matrix: 3 x 3 intrinsics in pixels of the frames as they are shown (turned upright); lens:
    their distortion. camera: both from a file, whose size must be the frames'. warn: takes what
    is missing at the end. Raises RecordingError: no readable video, another size.
    """
    if camera is not None:
        matrix, lens = camera.matrix, camera.lens
    video = cv2.VideoCapture(str(path))
    try:
        announced, count, last = round(video.get(cv2.CAP_PROP_FRAME_COUNT)), 0, -math.inf
        while True:
            read, pixels = video.read()
            if not read:
                break
            if camera is not None and pixels.shape[:2] != camera.size:
                raise RecordingError(f"{path}: {_sizes(pixels, camera)}")
            stamp = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if not stamp > last:
                raise RecordingError(f"{path}: frame {count} at {stamp} s comes after {last} s")
            count, last = count + 1, stamp
            image = np.ascontiguousarray(pixels[..., ::-1])
            yield FrameToRecord(image, None, matrix, None, stamp, lens)
    finally:
        video.release()
    if count == 0:
        raise RecordingError(f"{path}: expected a video file, no frame can be decoded")
    if count < announced:
        warn(f"{path}: {count} of {announced} announced frames could be decoded")


def _sizes(pixels: np.ndarray, camera: CameraYaml) -> str:
    return (
        f"frames have {pixels.shape[1]} x {pixels.shape[0]} pixels, "
        f"but the calibration is for {camera.size[1]} x {camera.size[0]}"
    )
