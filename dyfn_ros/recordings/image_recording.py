"""A video file or a folder of pictures read as a recording: images, and no depth."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import numpy as np

from dyfn_ros.recordings.frames import Notes, RecordedFrame
from dyfn_ros.recordings.pictures import exif_focal, pictures, pictures_in
from dyfn_ros.recordings.rgbd_folder import PLAIN_RATE, as_recorded
from dyfn_ros.recordings.rgbd_writer import FrameToRecord
from dyfn_ros.recordings.storage.open import is_recording
from dyfn_ros.recordings.topics import Topics
from dyfn_ros.recordings.video_file import expected_frames, is_video_name, video_frames


def is_image_recording(path: Path) -> bool:
    """Whether this is a file with a video's name, or a folder of pictures that is no bag."""
    if path.is_dir():
        return not is_recording(path) and bool(pictures_in(path))
    return path.is_file() and is_video_name(path)


def centred(focal: float, size: tuple[int, int]) -> np.ndarray:
    """3 x 3 pixels of a camera with its principal point in the middle of an image of (H, W)."""
    height, width = size
    return np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])


class ImageRecording:
    """Frames of a video with its times, or pictures of a folder at PLAIN_RATE, as if recorded."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics = Topics("frames" if path.is_file() else "pictures", None, None)
        self.notes = Notes()

    @property
    def expected_frames(self) -> int:
        """See Recording; an estimate for some videos."""
        return expected_frames(self.path) if self.path.is_file() else len(pictures_in(self.path))

    def doubts(self) -> list[str]:
        """See Recording."""
        return []

    def frames(self) -> Generator[RecordedFrame, None, None]:
        """See Recording."""
        self.notes = notes = Notes()
        lose: Callable[[str], None] = lambda reason: notes.losses.update([reason])  # noqa: E731
        made = _pictures(self.path, lose) if self.path.is_dir() else video_frames(self.path, lose)
        for index, frame in enumerate(made):
            yield as_recorded(index, frame)


def _pictures(folder: Path, lose: Callable[[str], None]) -> Iterator[FrameToRecord]:
    paths = pictures_in(folder)
    places = {path: number for number, path in enumerate(paths)}
    for path, image in pictures(paths, lose):
        size = (image.shape[0], image.shape[1])
        focal = exif_focal(path, size)
        matrix = None if focal is None else centred(focal, size)
        yield FrameToRecord(image, None, matrix, None, places[path] / PLAIN_RATE)
