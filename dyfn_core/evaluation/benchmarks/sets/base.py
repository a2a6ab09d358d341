"""What a benchmark is: named sequences of frames with truth, and how many of each are scored."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dyfn_core.data.frames import DataReport, FrameError, RgbdFrame
from dyfn_core.geometry.camera import pixel_intrinsics


@dataclass(frozen=True)
class BenchmarkFrame:
    """One frame to score.

    image: H x W x 3 uint8 RGB. truth: h x w float32 metres along the optical axis, of the same
    field of view; NaN, infinite or <= 0 where it is unknown. camera_matrix: 3 x 3 float64 in
    pixels of the image; None when unknown. pose: 4 x 4 float64 camera to world in metres, optical
    axes; None when unknown. stamp: seconds; None when unknown. sparse: h x w float32 metres of
    points that come with the frame, over the truth, NaN elsewhere; None without. context: the
    frame is run but not scored; its truth is NaN all over.
    """

    image: np.ndarray
    truth: np.ndarray
    camera_matrix: np.ndarray | None = None
    pose: np.ndarray | None = None
    stamp: float | None = None
    sparse: np.ndarray | None = None
    context: bool = False


@dataclass(frozen=True)
class BenchmarkSettings:
    """What of every sequence is scored (paper section 5).

    first: frames left out at the start. stride: every N-th frame from there on. frames: at
    most so many of these; None is all. depth_max: metres, farther truth is not scored. crop: rows
    cut off above and below, columns cut off left and right, in pixels of the truth.
    """

    first: int = 0
    stride: int = 1
    frames: int | None = None
    depth_max: float = math.inf
    crop: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        if self.first < 0 or self.stride < 1 or (self.frames is not None and self.frames < 1):
            raise ValueError(
                "first must be at least 0, stride and frames at least 1, got "
                f"first={self.first} stride={self.stride} frames={self.frames}"
            )
        if not self.depth_max > 0 or min(self.crop) < 0:
            raise ValueError(
                f"depth_max must be positive, crop not negative: {self.depth_max}, {self.crop}"
            )


@dataclass(frozen=True)
class BenchmarkSource:
    """All frames of one sequence on disk, in the order of time.

    numbers: their numbers as in the file names. read: the frames of given numbers (a rising
    selection), one at a time; raises FrameError for one that cannot be used.
    """

    name: str
    numbers: Sequence[int]
    read: Callable[[Sequence[int]], Iterator[BenchmarkFrame]]


@dataclass(frozen=True)
class BenchmarkSequence:
    """The scored frames of a sequence. numbers: theirs; available: frames that there are."""

    name: str
    numbers: tuple[int, ...]
    available: int
    source: BenchmarkSource
    crop: tuple[int, int] = (0, 0)

    def __len__(self) -> int:
        return len(self.numbers)

    def frames(self) -> Iterator[BenchmarkFrame]:
        """The frames, one at a time. Raises FrameError for one that cannot be used."""
        for frame in self.source.read(self.numbers):
            yield cropped(frame, self.crop, self.name)


UNREADABLE = "sequence that cannot be read"  # a report's reason; such a sequence is missing
Opener = Callable[[Path, DataReport], list[BenchmarkSource]]


@dataclass(frozen=True)
class Benchmark:
    """One data set.

    expected: the layout in words. sequences: names that a complete root holds; none: whatever is
    there. lengths: scored frames of a complete sequence, by name. video_set: its folder in
    DepthCrafter's layout, None where there is none.
    """

    name: str
    title: str
    expected: str
    settings: BenchmarkSettings
    open: Opener
    sequences: tuple[str, ...] = ()
    lengths: Mapping[str, int] = field(default_factory=dict)
    video_set: str | None = None


def select(source: BenchmarkSource, settings: BenchmarkSettings) -> BenchmarkSequence:
    """The frames of a source that the settings choose."""
    chosen = tuple(source.numbers[settings.first :: settings.stride][: settings.frames])
    return BenchmarkSequence(source.name, chosen, len(source.numbers), source, settings.crop)


def cropped(frame: BenchmarkFrame, crop: tuple[int, int], name: str) -> BenchmarkFrame:
    """The frame without its borders. Raises FrameError, naming the sequence, if image and truth
    differ in size or nothing would be left."""
    rows, columns = crop
    if not rows and not columns:
        return frame
    height, width = frame.truth.shape
    if frame.image.shape[:2] != frame.truth.shape:
        raise FrameError(
            f"{name}: a crop needs image and truth of one size, got {frame.image.shape[:2]} and "
            f"{frame.truth.shape}"
        )
    if 2 * rows >= height or 2 * columns >= width:
        raise FrameError(f"{name}: a crop of {crop} leaves nothing of {frame.truth.shape}")
    inside = (slice(rows, height - rows), slice(columns, width - columns))
    matrix = frame.camera_matrix
    if matrix is not None:
        matrix = matrix.copy()
        matrix[:2, 2] -= (columns, rows)
    return replace(
        frame,
        image=frame.image[inside],
        truth=frame.truth[inside],
        camera_matrix=matrix,
        sparse=None if frame.sparse is None else frame.sparse[inside],
    )


def from_rgbd(frame: RgbdFrame) -> BenchmarkFrame:
    """A frame of the training loaders, whose intrinsics are normalised."""
    fx, fy, cx, cy = frame.intrinsics.astype(np.float64)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    size = (frame.image.shape[0], frame.image.shape[1])
    camera = pixel_intrinsics(matrix, size)
    return BenchmarkFrame(frame.image, frame.depth, camera, frame.pose, frame.stamp)


def one_by_one(
    reader: Callable[[int], BenchmarkFrame],
) -> Callable[[Sequence[int]], Iterator[BenchmarkFrame]]:
    """Source.read for frames that are files of their own."""
    return lambda numbers: map(reader, numbers)
