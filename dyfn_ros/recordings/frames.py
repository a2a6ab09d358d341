"""What an opened recording gives: frames, and what went wrong on the way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from dyfn_ros.recordings.storage.base import Recorded
from dyfn_ros.recordings.topics import Topics


@dataclass(frozen=True)
class RecordedFrame:
    """One colour frame of a recording.

    index: 0, 1, 2 ... over the frames that could be read.
    stamp_ns: the header's stamp. frame_id: the header's.
    image: H x W x 3 uint8 RGB, lens distortion undone (and that of depth), as the node does.
    camera_matrix: 3 x 3 float64 in pixels; None without usable calibration.
    depth: H' x W' float32 metres, NaN invalid; None without ground truth for this stamp.
    visible: H x W bool, where undistortion found a picture; None: everywhere.
    lens_undone: whether the image as recorded had a lens, which `info` describes.
    source, info: the image and the latest CameraInfo as recorded (or made, for an RGB-D folder).
    """

    index: int
    stamp_ns: int
    frame_id: str
    image: np.ndarray
    camera_matrix: np.ndarray | None
    depth: np.ndarray | None
    source: Recorded
    info: Recorded | None
    visible: np.ndarray | None = None
    lens_undone: bool = False


@dataclass
class Notes:
    """What went wrong on the way, each reason once with its count.

    losses: data that is gone. warnings: data that is there but could not be used.
    """

    losses: Counter[str] = field(default_factory=Counter)
    warnings: Counter[str] = field(default_factory=Counter)


class Recording(Protocol):
    """An opened recording. notes is complete only after frames() has been exhausted."""

    path: Path
    topics: Topics
    notes: Notes

    @property
    def expected_frames(self) -> int:
        """How many images the recording says it has."""

    def frames(self) -> Generator[RecordedFrame, None, None]:
        """Every frame in log-time order, always the same for the same recording."""

    def doubts(self) -> list[str]:
        """What makes the pairs of images and depth implausible; complete after frames()."""
