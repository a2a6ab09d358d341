"""A video file or a folder of pictures read as a recording: images, and no depth."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

import numpy as np

from dyfn_core.data.rgbd.layouts import EXPECTED
from dyfn_core.data.rgbd.names import visible_files
from dyfn_ros.recordings.frames import Notes, RecordedFrame
from dyfn_ros.recordings.pictures import exif_focal, pictures, pictures_in
from dyfn_ros.recordings.rgbd_folder import PLAIN_RATE, as_recorded
from dyfn_ros.recordings.rgbd_writer import FrameToRecord
from dyfn_ros.recordings.storage.open import is_recording
from dyfn_ros.recordings.topics import Topics
from dyfn_ros.recordings.video_file import (
    expected_frames,
    is_video_name,
    video_frames,
    video_tracks,
)

_OF_DEPTH = re.compile(r"(?:^|[^a-z])(?:depth|disp|disparity)(?:[^a-z]|$)")


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
        self._pictures, of_depth = ([], []) if path.is_file() else _without_depth(path)
        self._warnings: Counter[str] = Counter()
        if of_depth:
            self._warnings[
                f"{len(of_depth)} files of depth by their names ({of_depth[0]}, ...): not read in "
                f"this folder of pictures; with depth is {EXPECTED}"
            ] = 1
        if kinds := _kinds_of_names(self._pictures):
            self._warnings[
                f"pictures of several kinds by their names ({', '.join(kinds)}) are taken for one "
                "sequence; give each a folder of its own"
            ] = 1
        if path.is_file() and (tracks := video_tracks(path)) > 1:
            self._warnings[f"of {tracks} tracks of pictures in {path.name} one is read"] = 1
        self.notes = Notes(warnings=self._warnings.copy())

    @property
    def expected_frames(self) -> int:
        """See Recording; an estimate for some videos."""
        return expected_frames(self.path) if self.path.is_file() else len(self._pictures)

    def doubts(self) -> list[str]:
        """See Recording."""
        return []

    def frames(self) -> Generator[RecordedFrame, None, None]:
        """See Recording."""
        self.notes = notes = Notes(warnings=self._warnings.copy())
        lose: Callable[[str], None] = lambda reason: notes.losses.update([reason])  # noqa: E731
        made = _pictures(self._pictures, lose)
        if self.path.is_file():
            made = video_frames(self.path, lose)
        for index, frame in enumerate(made):
            yield as_recorded(index, frame)


def _without_depth(folder: Path) -> tuple[list[Path], list[Path]]:
    """Pictures, and what is depth of them by its name, where that is not all there is."""
    found = pictures_in(folder)
    pictures = [path for path in found if not _OF_DEPTH.search(path.name.lower())]
    if not pictures:
        return found, []
    held = visible_files(folder)
    return pictures, [path for path in held if _OF_DEPTH.search(path.name.lower())]


def _kinds_of_names(paths: list[Path]) -> list[str]:
    """Names without their numbers, when several of these have a number in common."""
    numbers: dict[str, set[str]] = {}
    for path in paths:
        kind = re.sub(r"\d+", "#", path.stem)
        numbers.setdefault(kind, set()).update(["-".join(re.findall(r"\d+", path.stem))])
    shared = Counter(number for found in numbers.values() for number in found)
    return [
        kind
        for kind, found in numbers.items()
        if "#" in kind and any(shared[number] > 1 for number in found)
    ]


def _pictures(paths: list[Path], lose: Callable[[str], None]) -> Iterator[FrameToRecord]:
    places = {path: number for number, path in enumerate(paths)}
    for path, image in pictures(paths, lose):
        size = (image.shape[0], image.shape[1])
        focal = exif_focal(path, size)
        matrix = None if focal is None else centred(focal, size)
        yield FrameToRecord(image, None, matrix, None, places[path] / PLAIN_RATE)
