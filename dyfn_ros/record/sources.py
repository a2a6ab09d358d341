"""Frames of RGB-D folders of known layouts that a recording can be made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from dyfn_core.data.rgbd.layouts import EXPECTED, PLAIN, FolderOptions, find_folders
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.rgbd_folder import open_rgbd, rgbd_frames
from dyfn_ros.recordings.rgbd_writer import FrameToRecord

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
