"""What `dyfn-depth` reads: pictures, folders, videos, cameras, network streams."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Literal

import cv2
import numpy as np

from dyfn_ros.depth.live import Capture, LiveCapture, Open, open_capture
from dyfn_ros.depth.settings import RATE, Reading
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.pictures import is_picture_name, pictures, pictures_in, read_picture
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder, open_rgbd, rgbd_frames
from dyfn_ros.recordings.storage.open import is_recording
from dyfn_ros.recordings.video_file import expected_frames, video_frames

Kind = Literal["picture", "folder", "video", "live"]


@dataclass(frozen=True)
class SourceFrame:
    """One frame.

    Attributes:
        image: H x W x 3 uint8 RGB, upright.
        stamp: Seconds from the source's start.
        name: Of its files.
        file: The picture it was read from; None: of a video or a camera.
        camera_matrix: 3 x 3 pixels that the source itself gives; None: nothing.
    """

    image: np.ndarray
    stamp: float
    name: str
    file: Path | None = None
    camera_matrix: np.ndarray | None = None


@dataclass
class DepthSource:
    """An opened source; `frames` may be read once.

    Attributes:
        kind: What it is.
        name: That results are named after.
        folder: Where results go by default.
        frames: In order.
        expected: How many; None: not known.
        losses: What could not be read, with how often; complete after the last frame.
        live: Reads a camera or an address; None: a file.
        between: Told each frame that the stride leaves out, in its place.
    """

    kind: Kind
    name: str
    folder: Path
    frames: Iterator[SourceFrame]
    expected: int | None
    losses: Counter[str] = field(default_factory=Counter)
    live: LiveCapture | None = None
    between: Callable[[SourceFrame], None] = lambda frame: None


def open_source(
    reading: Reading, stopped: Callable[[], bool], capture: Open = open_capture
) -> DepthSource:
    """Open a source.

    Args:
        reading: What to read.
        stopped: Whether the user wants no more.
        capture: Opens cameras and addresses.

    Raises:
        RecordingError: It is not there, is of another kind, or gives no frame.
    """
    text = reading.source
    if text.isdecimal() or text.startswith("/dev/"):
        found = _camera(reading, stopped, capture)
    elif "://" in text:
        found = _address(reading, stopped, capture)
    else:
        found = _files(Path(text), reading)
    _refuse_idle(reading, found.kind)
    found.frames = _strided(found, found.frames, reading.stride)
    found.frames = islice(found.frames, reading.max_frames)
    if found.expected is not None:
        available = math.ceil(found.expected / reading.stride)
        found.expected = min(available, reading.max_frames or available)
    return found


def _strided(
    source: DepthSource, frames: Iterator[SourceFrame], stride: int
) -> Iterator[SourceFrame]:
    for index, frame in enumerate(frames):
        if index % stride:
            source.between(frame)
        else:
            yield frame


def _refuse_idle(reading: Reading, kind: Kind) -> None:
    if reading.capture_size is not None and kind != "live":
        raise RecordingError(f"{reading.source}: --capture-size is for webcams")
    if reading.rate is not None and kind in ("live", "picture"):
        raise RecordingError(f"{reading.source}: --rate is for folders and video files")


def _files(path: Path, reading: Reading) -> DepthSource:
    if not path.exists():
        raise RecordingError(
            f"{path} does not exist; expected a picture, a folder of pictures, a video file, a "
            "camera's number such as 0, or an address such as rtsp://..."
        )
    if is_recording(path):
        raise RecordingError(
            f"{path} is a recording, which dyfn-replay reads: dyfn-replay {path} --out DIR"
        )
    name, folder = path.resolve().stem if path.is_file() else path.resolve().name, path.parent
    losses: Counter[str] = Counter()
    lose: Callable[[str], None] = lambda reason: losses.update([reason])  # noqa: E731
    if path.is_dir():
        frames, count = _folder(path, reading.rate or RATE, lose)
        beside = path.resolve().parent if path.name in ("", "..") else path.parent
        return DepthSource("folder", name, beside, frames, count, losses)
    if is_picture_name(path):
        image = read_picture(path)
        frames = iter([SourceFrame(image, 0.0, name, path)])
        return DepthSource("picture", name, folder, frames, 1, losses)
    count = expected_frames(path)
    made = enumerate(video_frames(path, lose, rate=reading.rate))
    frames = (SourceFrame(one.image, one.stamp, f"{number:06d}") for number, one in made)
    return DepthSource("video", name, folder, frames, count or None, losses)


def _folder(
    path: Path, rate: float, lose: Callable[[str], None]
) -> tuple[Iterator[SourceFrame], int]:
    if is_rgbd_folder(path):
        folder = open_rgbd(path, lambda reason: None)  # of its depth, which is not read
        made = enumerate(rgbd_frames(folder, lose))
        frames = (
            SourceFrame(one.image, one.stamp, f"{n:06d}", camera_matrix=one.camera_matrix)
            for n, one in made
        )
        return frames, len(folder.frames)
    paths = pictures_in(path)
    if not paths:
        raise RecordingError(f"{path}: expected pictures (.jpg, .png, ...) and found none")
    stems = Counter(one.stem for one in paths)
    places = {one: place for place, one in enumerate(paths)}

    def read() -> Iterator[SourceFrame]:
        for one, image in pictures(paths, lose):
            name = one.stem if stems[one.stem] == 1 else one.name  # a.jpg and a.png
            yield SourceFrame(image, places[one] / rate, name, one)

    return read(), len(paths)


def _camera(reading: Reading, stopped: Callable[[], bool], capture: Open) -> DepthSource:
    text = reading.source
    opened = capture(text)
    if reading.capture_size is not None and opened.isOpened():
        height, width = reading.capture_size
        opened.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        opened.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
    number = text if text.isdecimal() else Path(text).name
    expected = "one that is plugged in and that no other program reads (ls /dev/video*)"
    return _live(LiveCapture(f"camera {text}", opened, expected), f"camera_{number}", stopped)


def _address(reading: Reading, stopped: Callable[[], bool], capture: Open) -> DepthSource:
    text = reading.source
    scheme, _, rest = text.partition("://")
    if scheme not in ("rtsp", "rtsps", "rtmp", "http", "https", "udp", "tcp", "srt"):
        raise RecordingError(f"{text}: expected an address such as rtsp://... or http://...")
    host = rest.rpartition("@")[2]  # messages must not show a password
    shown = f"{scheme}://{host}"
    path = host.split("?")[0]
    opened = capture(text)
    count = round(opened.get(cv2.CAP_PROP_FRAME_COUNT)) if opened.isOpened() else 0
    if count <= 0:
        expected = "an address that answers with a video"
        return _live(LiveCapture(shown, opened, expected), _file_name(path), stopped)
    losses: Counter[str] = Counter()
    frames = _all_frames(shown, opened, count, lambda reason: losses.update([reason]))
    name = _file_name(PurePosixPath(path).stem)  # walk of http://host/videos/walk.mp4
    return DepthSource("video", name, Path(), frames, count, losses)


def _file_name(text: str) -> str:
    return "".join(letter if letter.isalnum() or letter == "-" else "_" for letter in text)


def _all_frames(
    name: str, capture: Capture, count: int, lose: Callable[[str], None]
) -> Iterator[SourceFrame]:
    """Every frame of a file that lies at an address."""
    number = 0
    while True:
        done, pixels = capture.read()
        if not done:
            break
        stamp = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        yield SourceFrame(np.ascontiguousarray(pixels[..., ::-1]), stamp, f"{number:06d}")
        number += 1
    capture.release()
    if number < count:
        lose(f"{name}: {number} of {count} announced frames came")


def _live(live: LiveCapture, name: str, stopped: Callable[[], bool]) -> DepthSource:
    frames = (
        SourceFrame(image, stamp, f"{number:06d}")
        for number, (image, stamp) in enumerate(live.frames(stopped))
    )
    stamped = f"{name}_{time.strftime('%Y%m%d-%H%M%S')}"
    return DepthSource("live", stamped, Path(), frames, None, live=live)
