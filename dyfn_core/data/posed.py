"""Recordings of a camera whose poses are known, in the order of time, with or without depth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dyfn_core.data.frames import DataError, DataReport, FrameError
from dyfn_core.data.rgbd.cameras import Camera
from dyfn_core.data.rgbd.folder import FrameFiles, RgbdFolder
from dyfn_core.data.rgbd.layouts import FolderOptions, find_folders, open_folder

RATE = 10.0  # frames a second of folders without stamps
LEVELS = 2  # folders below the root that are searched


@dataclass(frozen=True)
class PosedFrame:
    """One picture.

    Attributes:
        image: H x W x 3 uint8 RGB, without lens distortion.
        stamp: Seconds.
        camera_matrix: 3 x 3 float64, pixels of the image.
        pose: 4 x 4 float64 camera to world, optical axes, metres; None when unknown.
        pose_variance: Rotation (rad^2) and translation (m^2) per axis, summed up along the way to
            the pose; None when unknown.
        depth: h x w float32 metres of the same view, NaN invalid; None without.
        visible: H x W bool, where the image shows something; None: everywhere.
    """

    image: np.ndarray
    stamp: float
    camera_matrix: np.ndarray
    pose: np.ndarray | None
    pose_variance: tuple[float, float] | None = None
    depth: np.ndarray | None = None
    visible: np.ndarray | None = None


@dataclass(frozen=True)
class PosedRecording:
    """One camera's pictures.

    Attributes:
        name: Where they are from.
        expected: How many there are when none is lost.
        frames: Gives them in the order of time.
        problems: What is not used, with how often; complete after the last frame.
    """

    name: str
    expected: int
    frames: Callable[[], Iterator[PosedFrame]]
    problems: Counter[str] = field(default_factory=Counter)


def posed_folders(
    root: Path,
    *,
    intrinsics: Camera | None = None,
    depth_scale: float | None = None,
    tolerance: float = 0.02,
) -> list[PosedRecording]:
    """The RGB-D folders in root and two levels below it that have poses.

    Args:
        root: Searched.
        intrinsics: fx, fy, cx, cy in pixels of the colour image, instead of a folder's own.
        depth_scale: Stored depth values per metre, instead of the layout's.
        tolerance: Seconds between a colour frame and its depth, in folders with stamps.

    Raises:
        DataError: A folder without poses or intrinsics, or with some that cannot be used.
    """
    options = FolderOptions(intrinsics, depth_scale, tolerance)
    return [_posed(path, options) for path in find_folders(root, LEVELS)]


def _posed(path: Path, options: FolderOptions) -> PosedRecording:
    report = DataReport(str(path))
    folder = open_folder(path, report, options)
    folder.check_camera(needed=True)
    if all(frame.pose is None for frame in folder.frames):
        raise DataError(f"{path}: expected poses (poses.txt, groundtruth.txt or .pose.txt)")
    problems = Counter({reason: len(names) for reason, names in report.problems.items()})
    return PosedRecording(
        str(path), len(folder.frames), lambda: _frames(folder, problems), problems
    )


def _frames(folder: RgbdFolder, problems: Counter[str]) -> Iterator[PosedFrame]:
    for index, files in enumerate(folder.frames):
        try:
            yield _read(folder, files, index)
        except FrameError as error:
            problems[str(error)] += 1


def _read(folder: RgbdFolder, files: FrameFiles, index: int) -> PosedFrame:
    image = folder.image(files)
    camera = folder.camera_at((image.shape[0], image.shape[1]))
    assert camera is not None  # checked when the folder was opened
    fx, fy, cx, cy = camera
    return PosedFrame(
        image=image,
        stamp=index / RATE if files.stamp is None else files.stamp,
        camera_matrix=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
        pose=files.pose,
        depth=folder.depth(files),
    )
