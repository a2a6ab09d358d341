"""RGB-D folders of every layout of data.rgbd as training data, cut where frames are missing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dyfn_core.data.frames import (
    DataReport,
    FrameSequence,
    NumberedSequence,
    RgbdFrame,
    uninterrupted,
)
from dyfn_core.data.rgbd.cameras import Camera
from dyfn_core.data.rgbd.folder import FrameFiles, RgbdFolder
from dyfn_core.data.rgbd.layouts import EXPECTED, FolderOptions, find_folders, open_folder

__all__ = ["EXPECTED", "is_rgbd_folder", "open_rgbd_folder", "whole_sequence"]

LEVELS = 2  # folders below the root that are searched


def open_rgbd_folder(
    root: Path,
    report: DataReport,
    *,
    intrinsics: Camera | None = None,
    depth_scale: float | None = None,
    tolerance: float = 0.02,
    max_gap: float = 0.5,
    max_missing: int = 2,
) -> list[FrameSequence]:
    """All folders of a known layout in root and two levels below it.

    Args:
        root: searched.
        report: counts what cannot be used.
        intrinsics: fx, fy, cx, cy in pixels of the colour image, instead of the folder's own.
        depth_scale: stored depth values per metre, instead of the layout's.
        tolerance: seconds between a colour frame and its depth, in folders with stamps.
        max_gap: seconds between frames that are a cut, in folders with stamps.
        max_missing: more frames than this missing from the numbers are a cut, in the others.

    Raises:
        DataError: a folder without intrinsics, or with some that cannot be of its images.
    """
    options = FolderOptions(intrinsics, depth_scale, tolerance)
    sequences: list[FrameSequence] = []
    for path in find_folders(root, LEVELS):
        folder = open_folder(path, report, options)
        sequence = whole_sequence(folder, report)
        if sequence is None:
            continue
        if all(frame.stamp is not None for frame in folder.frames):
            for run in _runs(folder.with_depth, max_gap):
                sequences.append(NumberedSequence(sequence.name, run, sequence.reader))
        else:
            largest = _usual_step(sequence.numbers) * (1 + max_missing)
            sequences += uninterrupted(sequence.name, sequence.numbers, sequence.reader, largest)
    return sequences


def whole_sequence(folder: RgbdFolder, report: DataReport) -> NumberedSequence | None:
    """The frames with depth of a folder as one sequence, whatever it lacks.

    Returns:
        The sequence; None when the folder has no depth, which the report counts.

    Raises:
        DataError: no intrinsics, or some that cannot be of these images.
    """
    frames = {frame.number: frame for frame in folder.with_depth}
    if not frames:
        report.miss("folder without a frame that has depth", folder.path)
        return None
    folder.check_camera(needed=True)
    return NumberedSequence(str(folder.path), list(frames), _Reader(folder, frames))


def is_rgbd_folder(root: Path) -> bool:
    """Whether root or a folder two levels below has a known layout."""
    return next(find_folders(root, LEVELS), None) is not None


class _Reader:
    """Reads a frame by its number."""

    def __init__(self, folder: RgbdFolder, frames: dict[int, FrameFiles]) -> None:
        self.folder, self.frames = folder, frames

    def __call__(self, number: int) -> RgbdFrame:
        return self.folder.read(self.frames[number])


def _runs(frames: Sequence[FrameFiles], max_gap: float) -> list[list[int]]:
    """The numbers of the frames, split where the stamps are further apart than max_gap."""
    runs: list[list[int]] = []
    previous = -np.inf
    for frame in frames:
        stamp = 0.0 if frame.stamp is None else frame.stamp
        if stamp - previous > max_gap:
            runs.append([])
        runs[-1].append(frame.number)
        previous = stamp
    return runs


def _usual_step(numbers: Sequence[int]) -> int:
    """The most common difference of neighbours: exports may hold every tenth frame."""
    steps = Counter(np.diff(numbers).tolist())
    return steps.most_common(1)[0][0] if steps else 1
