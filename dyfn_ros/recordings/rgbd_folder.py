"""An RGB-D folder read as a recording."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.data.files import registered
from dyfn_core.data.frames import DataError, DataReport, FrameError
from dyfn_core.data.rgbd.cameras import FolderCamera
from dyfn_core.data.rgbd.folder import FrameFiles, RgbdFolder
from dyfn_core.data.rgbd.layouts import (
    PLAIN,
    FolderOptions,
    depth_folder,
    layout_of,
    open_folder,
)
from dyfn_core.data.rgbd.lists import ABSENT
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import Notes, RecordedFrame
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, in_nanoseconds
from dyfn_ros.recordings.storage.base import Recorded
from dyfn_ros.recordings.topics import Topics
from dyfn_ros.recordings.typestore import CAMERA_INFO, IMAGE, TYPES, camera_info, image_message

PLAIN_RATE, SENSOR_RATE = 10.0, 30.0  # frames a second of folders without stamps
Lose = Callable[[str], None]


def is_rgbd_folder(path: Path) -> bool:
    """Whether the folder has a layout of RGB-D folders and is no rosbag2 folder."""
    return layout_of(path) is not None and not (path / "metadata.yaml").exists()


def open_rgbd(
    path: Path, warn: Lose, options: FolderOptions | None = None, lose: Lose | None = None
) -> RgbdFolder:
    """Find the frames of an RGB-D folder.

    Args:
        path: of a layout of dyfn_core.data.rgbd.
        warn: takes what is not used, a line for each reason.
        options: instead of what the folder says.
        lose: takes the files that a list names and that are gone, one by one; warn by default.

    Raises:
        RecordingError: another layout, a file of text that cannot be read, or intrinsics that
            cannot be of these images.
    """
    report = DataReport(str(path))
    try:
        folder = open_folder(path, report, options)
        folder.check_camera()
    except DataError as error:
        raise RecordingError(str(error)) from error
    for reason, names in report.problems.items():
        if lose is not None and reason.endswith(ABSENT):
            for name in names:
                lose(f"{name}: {reason}")
            continue
        warn(f"{len(names)} x {reason} ({names[0]}{', ...' if names[1:] else ''})")
    return folder


def rgbd_frames(
    folder: RgbdFolder, lose: Lose, rate: float | None = None, same_size: bool = False
) -> Iterator[FrameToRecord]:
    """The frames of an RGB-D folder, in the order of time, those without depth as well.

    Args:
        folder: as open_rgbd gives it.
        lose: takes what is wrong with a picture, which is then left out; the stamps stay.
        rate: frames a second where the folder has no stamps; None: 10 for the plain layout, whose
            frames are counted, 30 for the others, whose numbers are.
        same_size: bring colour and depth of different sizes to the smaller one.
    """
    for files, stamp in zip(folder.frames, _stamps(folder, rate), strict=True):
        image = _attempt(folder.image, files, lose)
        if image is None:
            continue
        depth = _attempt(folder.depth, files, lose)
        camera = _camera(folder, image, lose)
        if same_size and depth is not None and files.depth is not None:
            try:
                image, depth, camera = _same_size(image, depth, camera, files.depth)
            except FrameError as error:
                lose(str(error))
                depth = None
        yield FrameToRecord(
            image=image,
            depth_m=depth,
            camera_matrix=None if camera is None else _matrix(camera),
            pose=files.pose,
            stamp=stamp,
        )


def _stamps(folder: RgbdFolder, rate: float | None = None) -> list[float]:
    """Seconds of every frame; see rgbd_frames."""
    counted = folder.layout == PLAIN
    rate = rate or (PLAIN_RATE if counted else SENSOR_RATE)
    first = folder.frames[0].number
    return [
        (index if counted else files.number - first) / rate if files.stamp is None else files.stamp
        for index, files in enumerate(folder.frames)
    ]


def read_poses(path: Path) -> dict[int, np.ndarray]:
    """4 x 4 camera to world by the frames' stamps in nanoseconds, where it is known.

    Raises RecordingError as open_rgbd does.
    """
    folder = open_rgbd(path, warn=lambda reason: None)
    stamps = map(in_nanoseconds, _stamps(folder))
    placed = zip(stamps, folder.frames, strict=True)
    return {stamp: files.pose for stamp, files in placed if files.pose is not None}


def _attempt(
    read: Callable[[FrameFiles], np.ndarray | None], files: FrameFiles, lose: Lose
) -> np.ndarray | None:
    try:
        return read(files)
    except FrameError as error:
        lose(str(error))
        return None


def _camera(folder: RgbdFolder, image: np.ndarray, lose: Lose) -> FolderCamera | None:
    """The intrinsics of an image of this size."""
    if folder.camera is None:
        return None
    size = (image.shape[0], image.shape[1])
    try:
        return FolderCamera(folder.camera.at(size), folder.camera.source, size)
    except FrameError as error:
        lose(str(error))
        return None


def _same_size(
    image: np.ndarray, depth: np.ndarray, camera: FolderCamera | None, path: Path
) -> tuple[np.ndarray, np.ndarray, FolderCamera | None]:
    image, depth = registered(image, depth, path)
    size = (image.shape[0], image.shape[1])
    if camera is not None:
        camera = FolderCamera(camera.at(size), camera.source, size)
    return image, depth, camera


def _matrix(camera: FolderCamera) -> np.ndarray:
    fx, fy, cx, cy = camera.pixels
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


class RgbdRecording:
    """Frames of an RGB-D folder, as if they had been recorded."""

    def __init__(self, path: Path, options: FolderOptions | None = None) -> None:
        self.path = path
        self._warnings: Counter[str] = Counter()
        self._gone: list[str] = []
        self._folder = open_rgbd(
            path, lambda reason: self._warnings.update([reason]), options, self._gone.append
        )
        has_depth = bool(self._folder.with_depth) or depth_folder(path).is_dir()
        self.topics = Topics("rgb/", "K.txt", "depth/" if has_depth else None)
        self._take_notes()

    @property
    def expected_frames(self) -> int:
        """See Recording."""
        return len(self._folder.frames)

    def doubts(self) -> list[str]:
        """See Recording; files have no time of recording."""
        return [*self._folder.doubts]

    def frames(self) -> Generator[RecordedFrame, None, None]:
        """See Recording."""
        for index, frame in enumerate(rgbd_frames(self._folder, self._take_notes())):
            yield as_recorded(index, frame)

    def _take_notes(self) -> Lose:
        """Begin with what was found when the folder was opened; -> takes what is lost."""
        self.notes = Notes(warnings=self._warnings.copy())
        alike: dict[str, str] = {}  # what is wrong, without the file -> the first that says it

        def lose(reason: str) -> None:
            _, separator, what = reason.partition(": ")
            self.notes.losses[alike.setdefault(what, reason) if separator else reason] += 1

        for reason in self._gone:
            lose(reason)
        return lose


def as_recorded(index: int, frame: FrameToRecord) -> RecordedFrame:
    """A frame as a recording gives it, with messages made of it."""
    stamp_ns, frame_id = frame.stamp_ns, "camera_optical"
    image = image_message(frame.image, "rgb8", stamp_ns, frame_id)
    info = None
    if frame.camera_matrix is not None:
        size = frame.image.shape[:2]
        message = camera_info(frame.camera_matrix, size, stamp_ns, frame_id)
        info = _made("/camera/camera_info", CAMERA_INFO, message, stamp_ns)
    return RecordedFrame(
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
