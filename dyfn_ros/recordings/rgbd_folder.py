"""An RGB-D folder (rgb/, depth/, K.txt, poses.txt) read as a sequence of frames."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import Notes, RecordedFrame
from dyfn_ros.recordings.rgbd_writer import FrameToRecord
from dyfn_ros.recordings.storage.base import Recorded
from dyfn_ros.recordings.topics import Topics
from dyfn_ros.recordings.typestore import CAMERA_INFO, IMAGE, TYPES, camera_info, image_message

IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png"}


def is_rgbd_folder(path: Path) -> bool:
    """Whether the folder holds rgb/ and no recording."""
    return (path / "rgb").is_dir() and not (path / "metadata.yaml").exists()


def numbered(folder: Path, suffixes: set[str]) -> list[Path]:
    """Image files of a folder in numeric order of their names (9 before 10)."""
    files = (f for f in folder.iterdir() if f.suffix.lower() in suffixes)
    return sorted(files, key=lambda f: ([int(n) for n in re.findall(r"\d+", f.stem)], f.name))


def read_rgbd_folder(
    path: str | Path, rate: float = 10.0, lose: Callable[[str], None] | None = None
) -> Iterator[FrameToRecord]:
    """Frames of `rgb/*.jpg|png` with `depth/<same name>.png`, stamped 0, 1/rate, 2/rate ...

    depth: uint16 millimetres, 0 = none. `K.txt`: 3 x 3 intrinsics in pixels. `poses.txt`: a
    row-major 4 x 4 camera-to-world matrix a line, one per colour frame. All three are optional.
    lose: takes what is wrong with a picture, which is then left out; the stamps stay.
    Raises RecordingError naming the file that is missing, unreadable or of the wrong shape.
    """
    folder = Path(path)
    files = numbered(folder / "rgb", IMAGE_SUFFIXES) if (folder / "rgb").is_dir() else []
    if not files:
        raise RecordingError(f"{folder}: expected colour images (jpg or png) in {folder / 'rgb'}")
    camera_matrix = _matrix(folder / "K.txt", (3, 3))
    poses = _matrix(folder / "poses.txt", (len(files), 4, 4))
    for index, file in enumerate(files):
        image = _attempt(_colour, file, lose)
        if image is None:
            continue
        yield FrameToRecord(
            image=image,
            depth_m=_attempt(_depth, folder / "depth" / f"{file.stem}.png", lose),
            camera_matrix=camera_matrix,
            pose=None if poses is None else poses[index],
            stamp=index / rate,
        )


def read_poses(folder: Path) -> np.ndarray | None:
    """N x 4 x 4 camera to world, one per colour frame; None without `poses.txt`.

    Raises RecordingError when it has another number of rows than there are colour images.
    """
    return _matrix(folder / "poses.txt", (len(numbered(folder / "rgb", IMAGE_SUFFIXES)), 4, 4))


def _attempt(
    read: Callable[[Path], np.ndarray | None], file: Path, lose: Callable[[str], None] | None
) -> np.ndarray | None:
    try:
        return read(file)
    except RecordingError as error:
        if lose is None:
            raise
        lose(str(error))
        return None


def _matrix(file: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    if not file.exists():
        return None
    try:
        return np.loadtxt(file, dtype=np.float64).reshape(shape)
    except ValueError as error:
        raise RecordingError(f"{file}: expected numbers of shape {shape}: {error}") from error


def _colour(file: Path) -> np.ndarray:
    pixels = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if pixels is None:
        raise RecordingError(f"{file}: expected a colour image, cannot decode it")
    return np.ascontiguousarray(pixels[..., ::-1])


def _depth(file: Path) -> np.ndarray | None:
    if not file.exists():
        return None
    pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        found = "an unreadable file" if pixels is None else f"{pixels.dtype} {pixels.shape}"
        raise RecordingError(f"{file}: expected a 16-bit one-channel PNG in mm, found {found}")
    metres = pixels.astype(np.float32) / 1000
    return np.where(pixels > 0, metres, np.float32(np.nan))


class RgbdRecording:
    """Frames of an RGB-D folder, as if they had been recorded at a fixed rate."""

    topics = Topics("rgb/", "K.txt", "depth/")

    def __init__(self, path: Path, rate: float = 10.0) -> None:
        self.path = path
        self.notes = Notes()
        self._rate = rate

    @property
    def expected_frames(self) -> int:
        """See Recording."""
        return len(numbered(self.path / "rgb", IMAGE_SUFFIXES))

    def frames(self) -> Iterator[RecordedFrame]:
        """See Recording."""
        frame_id = "camera_optical"
        self.notes = Notes()

        def lose(reason: str) -> None:
            self.notes.losses[reason] += 1

        for index, frame in enumerate(read_rgbd_folder(self.path, self._rate, lose)):
            stamp_ns = round(frame.stamp * 1e9)
            image = image_message(frame.image, "rgb8", stamp_ns, frame_id)
            info = None
            if frame.camera_matrix is not None:
                size = frame.image.shape[:2]
                message = camera_info(frame.camera_matrix, size, stamp_ns, frame_id)
                info = _made("/camera/camera_info", CAMERA_INFO, message, stamp_ns)
            yield RecordedFrame(
                index=index,
                stamp_ns=stamp_ns,
                frame_id=frame_id,
                image=frame.image,
                camera_matrix=frame.camera_matrix,
                depth=frame.depth_m,
                source=_made("/camera/image", IMAGE, image, stamp_ns),
                info=info,
            )


def _made(topic: str, kind: str, message: Any, stamp_ns: int) -> Recorded:
    return Recorded(topic, kind, stamp_ns, bytes(TYPES.serialize_cdr(message, kind)))
