"""IRS: indoor stereo, disparity in OpenEXR."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from dyfn_core.data.files import (
    folders_holding,
    numbered_files,
    read_colour,
    read_exr,
    rgbd_frame,
    with_depth,
)
from dyfn_core.data.frames import DataReport, FrameSequence, RgbdFrame, uninterrupted

EXPECTED = "{Home,Office,Restaurant,Store}/<scene>/l_00001.png with d_00001.exr beside it"
SIZE = (540, 960)
FOCAL, BASELINE = 480.0, 0.1  # pixels, metres
SMALLEST_DISPARITY = 0.5  # pixels: 96 m
INTRINSICS = np.array([FOCAL / SIZE[1], FOCAL / SIZE[0], 0.5, 0.5], np.float32)


def open_irs(root: Path, report: DataReport) -> list[FrameSequence]:
    """Left frames, 960 x 540, z = 0.1 * 480 / disparity; below 0.5 px is invalid. No poses."""
    sequences: list[FrameSequence] = []
    for folder in folders_holding(root, "l_*.png", 3):
        images = numbered_files(folder, r"l_(\d+)\.png")
        files = with_depth(images, numbered_files(folder, r"d_(\d+)\.exr"), report)
        name = str(folder.relative_to(root))
        sequences += uninterrupted(name, list(files), partial(_read, files))
    return sequences


def _read(files: dict[int, tuple[Path, Path]], number: int) -> RgbdFrame:
    image, depth = files[number]
    disparity = read_exr(depth)
    valid = disparity >= SMALLEST_DISPARITY
    metres = np.where(valid, FOCAL * BASELINE / np.where(valid, disparity, 1), np.nan)
    return rgbd_frame(read_colour(image, SIZE), metres, INTRINSICS, None, depth)
