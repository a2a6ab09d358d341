"""Ordered RGB-D frames to evaluate on: rendered clips, and recordings kept as image folders."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dyfn_core.data.frames import DataError, DataReport, FrameSequence
from dyfn_core.data.rgbd.layouts import open_folder

logger = logging.getLogger(__name__)


def clip_frames(clip: FrameSequence, stride: int = 1) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Every `stride`-th frame of a sequence: RGB uint8 and depth in metres."""
    for index in range(0, len(clip), stride):
        frame = clip.read(index)
        yield frame.image, frame.depth


def folder_frames(folder: Path, stride: int = 1) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Every `stride`-th frame with depth of an RGB-D folder, in the order of time.

    Args:
        folder: of one of the layouts of data.rgbd. What of it is not used is logged.
        stride: of the frames that have depth.

    Yields:
        H x W x 3 uint8 RGB and H x W float32 metres, NaN invalid, both at the smaller one's size.

    Raises:
        DataError: another layout, or no frame with depth.
        FrameError: a picture cannot be read; the message names it.
    """
    report = DataReport(str(folder))
    opened = open_folder(folder, report)
    report.sequences, report.frames = 1, len(opened.with_depth)
    if not report.frames:
        raise DataError(f"{report.summary()}: expected frames with depth")
    if report.problems:
        logger.warning("%s", report.summary())
    yield from opened.pairs(stride)
