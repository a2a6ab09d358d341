"""DepthCrafter's layout of any benchmark: a video and one array of truth per sequence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.frames import DataReport, FrameError
from dyfn_core.evaluation.benchmarks.arrays import frames_of_array, npz_key
from dyfn_core.evaluation.benchmarks.sets.base import UNREADABLE, BenchmarkFrame, BenchmarkSource

EXPECTED = (
    "<set>/<sequence>_rgb_left.mp4 and <set>/<sequence>_disparity.npz, whose key `disparity` "
    "(T x 1 x H x W) holds depth in metres"
)
VIDEO, TRUTH = "_rgb_left.mp4", "_disparity.npz"
KEYS = ("disparity", "arr_0")


def video_folder(root: Path, video_set: str) -> Path | None:
    """Where a set's videos are: in the root's folder of that name, or in the root itself."""
    for folder in (root / video_set, root):
        if next(folder.glob(f"*{VIDEO}"), None) is not None:
            return folder
    return None


def open_videos(folder: Path, report: DataReport) -> list[BenchmarkSource]:
    """Sequences by the name before `_rgb_left.mp4`. Truth <= 0 is invalid (0 or -1 in the files).

    Truth is paired with its video by name. There is no camera and no pose. Pairs
    that cannot be read are counted in the report.
    """
    found = []
    for video in sorted(folder.glob(f"*{VIDEO}")):
        name = video.name.removesuffix(VIDEO)
        truth = folder / f"{name}{TRUTH}"
        if not truth.exists():
            report.miss(f"video without its {TRUTH}", video)
            continue
        try:
            shape, _ = frames_of_array(truth, npz_key(truth, KEYS))
        except FrameError as error:
            report.miss(UNREADABLE, error)
            continue
        found.append(BenchmarkSource(name, range(shape[0]), partial(_read, video, truth)))
    for truth in sorted(folder.glob(f"*{TRUTH}")):
        if not truth.with_name(truth.name.removesuffix(TRUTH) + VIDEO).exists():
            report.miss(f"truth without its {VIDEO}", truth)
    return found


def _read(video: Path, truth: Path, numbers: Sequence[int]) -> Iterator[BenchmarkFrame]:
    _, arrays = frames_of_array(truth, npz_key(truth, KEYS))
    wanted, last = set(numbers), max(numbers, default=-1)
    for number, (image, depth) in enumerate(zip(_images(video), arrays, strict=False)):
        if number in wanted:
            depth = depth.astype(np.float32)
            yield BenchmarkFrame(image, np.where(depth > 0, depth, np.float32(np.nan)))
            wanted.discard(number)
        if number >= last:
            return
    if wanted:
        raise FrameError(
            f"{video}: the video ends before frame {min(wanted)}, but {truth.name} has truth for it"
        )


def _images(path: Path) -> Iterator[np.ndarray]:
    """Every frame of a video, H x W x 3 uint8 RGB."""
    capture = cv2.VideoCapture(str(path.absolute()))
    try:
        if not capture.isOpened():
            raise FrameError(f"{path}: no video that can be decoded")
        while True:
            there, image = capture.read()
            if not there:
                return
            yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    finally:
        capture.release()
