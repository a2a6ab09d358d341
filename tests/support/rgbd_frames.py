"""Frames of an RGB-D recording."""

from __future__ import annotations

import cv2
import numpy as np

from dyfn_ros.recordings.rgbd_writer import FrameToRecord

SIZE = (36, 48)
CAMERA = np.array([[40.0, 0, 23.5], [0, 40.0, 17.5], [0, 0, 1]])


def rgbd(count: int, truth: bool = True) -> list[FrameToRecord]:
    rng = np.random.default_rng(3)
    made = []
    for index in range(count):
        image = cv2.resize(rng.integers(0, 255, (5, 6, 3), np.uint8), SIZE[::-1])
        depth = cv2.resize(rng.uniform(1, 4, (4, 5)), SIZE[::-1])
        depth[:3] = 0
        made.append(FrameToRecord(image, depth if truth else None, CAMERA, None, 50 + index / 15))
    return made
