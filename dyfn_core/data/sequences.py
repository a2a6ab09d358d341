"""Ordered RGB-D frames to evaluate on: rendered clips, and recordings kept as image folders."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.frames import FrameSequence


def clip_frames(clip: FrameSequence, stride: int = 1) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Every `stride`-th frame of a sequence: RGB uint8 and depth in metres."""
    for index in range(0, len(clip), stride):
        frame = clip.read(index)
        yield frame.image, frame.depth


def folder_frames(folder: Path, stride: int = 1) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Every `stride`-th frame of a folder with rgb/N.jpg and depth/N.png (millimetres, 0 invalid).

    Raises FileNotFoundError when the folder has no frames, or naming what cannot be read.
    """
    paths = sorted((folder / "rgb").glob("*.jpg"), key=lambda path: (len(path.stem), path.stem))
    if not paths:
        raise FileNotFoundError(f"no rgb/*.jpg under {folder}")
    for path in paths[::stride]:
        depth_path = folder / "depth" / f"{path.stem}.png"
        image = cv2.imread(str(path))
        depth = cv2.imread(str(depth_path), cv2.IMREAD_UNCHANGED)
        if image is None or depth is None:
            raise FileNotFoundError(f"cannot read {path if image is None else depth_path}")
        yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB), depth.astype(np.float32) / 1000
