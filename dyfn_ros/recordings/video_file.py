"""Video files: their frames with the times that the file gives them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.heads import told_by_head
from dyfn_ros.recordings.camera_yaml import CameraYaml
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_writer import FrameToRecord
from dyfn_ros.recordings.typestore import Lens

VIDEO_SUFFIXES = (
    *(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts"),
    *(".wmv", ".flv", ".gif"),
    *(".h264", ".264", ".h265", ".265", ".hevc"),  # streams without a container, and times
)
COVER = 0x400  # a track that is a picture of the cover, in its disposition
SHORT = 2.0  # seconds that a file may end before its announced length
Warn = Callable[[str], None]


def is_video_name(path: Path) -> bool:
    """Whether a file's name is that of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def expected_frames(path: Path) -> int:
    """How many frames a video announces, 0 when it does not say; an estimate in some containers."""
    video = cv2.VideoCapture(str(path.absolute()))  # 12:30.mp4 is no address
    try:
        return max(0, round(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        video.release()


def video_tracks(path: Path) -> int:
    """How many sequences of pictures a video holds (of cameras that record depth beside colour);
    0 when PyAV, of the extra `video`, is not installed or cannot say."""
    try:
        import av
    except ImportError:
        return 0
    try:
        with av.open(str(path.absolute())) as video:
            return sum(not track.disposition & COVER for track in video.streams.video)
    except (av.FFmpegError, OSError, ValueError):
        return 0


def video_frames(
    path: Path,
    warn: Warn,
    matrix: np.ndarray | None = None,
    lens: Lens | None = None,
    camera: CameraYaml | None = None,
    rate: float | None = None,
) -> Iterator[FrameToRecord]:
    """Frames of a video file that OpenCV can decode, stamped with their own times from its start.

    Frames whose time does not rise are left out. A rotated video comes upright.

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
    video = cv2.VideoCapture(str(path.absolute()))  # 12:30.mp4 is no address
    try:
        announced, fps = (video.get(p) for p in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
        decoded, last, longest, late = 0, -math.inf, 0.0, []
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
            longest = max(longest, stamp - last) if math.isfinite(last) else 0.0
            last = stamp
            image = np.ascontiguousarray(pixels[..., ::-1])
            yield FrameToRecord(image, None, matrix, None, stamp, lens)
    finally:
        video.release()
    if decoded == 0:
        told = told_by_head(path, "video")
        why = f"it is {told}" if told else "no frame can be decoded"
        raise RecordingError(f"{path}: expected a video file, {why}")
    if late and len(late) == decoded - 1:
        raise RecordingError(
            f"{path}: holds no times of its {decoded} frames (a raw H.264 or H.265 stream has "
            "none); give --rate to dyfn-record, or put it into a container such as .mp4"
        )
    if late:
        warn(f"{path}: {len(late)} frames whose time does not rise are left out ({late[0]})")
    if _counts_frames(path):
        if decoded < round(announced):
            warn(f"{path}: {decoded} of {round(announced)} announced frames could be decoded")
    elif rate is None and fps > 0 and announced / fps > last + max(SHORT, 3 * longest):
        warn(f"{path}: ends {last:.1f} s from its start, announced are {announced / fps:.1f} s")


def _counts_frames(path: Path) -> bool:
    """Whether the container counts its frames; others have a length, and a mean rate at most."""
    with path.open("rb") as file:
        head = file.read(12)
    return head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free") or head[:4] == b"RIFF"


def _sizes(pixels: np.ndarray, camera: CameraYaml) -> str:
    return (
        f"frames have {pixels.shape[1]} x {pixels.shape[0]} pixels, "
        f"but the calibration is for {camera.size[1]} x {camera.size[0]}"
    )
