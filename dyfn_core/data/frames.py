"""What every data set is made of: frames with depth, in sequences without a cut."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

SHOWN = 3  # names of each problem in a summary


class FrameError(ValueError):
    """A frame that cannot be used; the message names the file and what was expected."""


class DataError(ValueError):
    """Data that cannot be trained on; the message says what was expected and what was found."""


@dataclass(frozen=True)
class RgbdFrame:
    """One view with its geometry.

    image: H x W x 3 uint8 RGB. depth: H x W float32 metres along the optical axis, inf where
    nothing is hit (sky), NaN where it is unknown. intrinsics: normalised fx, fy, cx, cy (fx and cx
    in units of the width, fy and cy of the height, the image's corner at 0), float32. pose: 4 x 4
    float64 camera to world in metres, optical axes (x right, y down, z forward), or None. stamp:
    seconds, where the data set has stamps.
    """

    image: np.ndarray
    depth: np.ndarray
    intrinsics: np.ndarray
    pose: np.ndarray | None = None
    stamp: float | None = None


class FrameSequence(Protocol):
    """Frames of one camera in the order of time, without a cut between any two neighbours."""

    @property
    def name(self) -> str:
        """Where it is from, for messages."""

    def __len__(self) -> int: ...

    def read(self, index: int) -> RgbdFrame:
        """The index-th frame. Raises FrameError when it cannot be used."""


@dataclass(frozen=True)
class NumberedSequence:
    """Frames by their numbers on disk; reader(number) reads one and raises FrameError."""

    name: str
    numbers: Sequence[int]
    reader: Callable[[int], RgbdFrame]

    def __len__(self) -> int:
        return len(self.numbers)

    def read(self, index: int) -> RgbdFrame:
        """See FrameSequence."""
        return self.reader(self.numbers[index])


@dataclass
class DataReport:
    """What was found in a data set, and what of it could not be used.

    name: the data set's kind and root. sequences, frames: usable ones. problems: reason -> names
    of the files or sequences that it holds for.
    """

    name: str
    sequences: int = 0
    frames: int = 0
    problems: dict[str, list[str]] = field(default_factory=dict)

    def miss(self, reason: str, what: object) -> None:
        """Count one thing that cannot be used, by its reason."""
        self.problems.setdefault(reason, []).append(str(what))

    def summary(self) -> str:
        """One line: what is used, then each reason with its count and the first names."""
        parts = [f"{self.name}: {self.frames} frames in {self.sequences} sequences"]
        for reason, names in self.problems.items():
            different = list(dict.fromkeys(names))
            more = ", ..." if len(different) > SHOWN else ""
            parts.append(f"{len(names)} x {reason} ({', '.join(different[:SHOWN])}{more})")
        return "; ".join(parts)


def uninterrupted(
    name: str,
    numbers: Sequence[int],
    reader: Callable[[int], RgbdFrame],
    largest_step: int = 1,
) -> list[NumberedSequence]:
    """Sequences of frames whose numbers rise by `largest_step` at most, split where they jump.

    numbers: in any order.
    """
    ordered = sorted(set(numbers))
    starts = [
        place
        for place, number in enumerate(ordered)
        if place == 0 or number - ordered[place - 1] > largest_step
    ]
    runs = [ordered[a:b] for a, b in zip(starts, [*starts[1:], len(ordered)], strict=True)]
    return [
        NumberedSequence(name if len(runs) == 1 else f"{name}[{run[0]}..{run[-1]}]", run, reader)
        for run in runs
    ]


def camera_intrinsics(
    fx: float, fy: float, cx: float, cy: float, size: tuple[int, int], owner: object = None
) -> np.ndarray:
    """Pixels of an image of size (H, W), the first pixel's centre at 0 -> normalised, float32.

    Raises FrameError, naming the owner if given, unless they are finite and the focal lengths
    positive.
    """
    height, width = size
    values = np.array([fx / width, fy / height, (cx + 0.5) / width, (cy + 0.5) / height])
    if not np.isfinite(values).all() or fx <= 0 or fy <= 0:
        named = "" if owner is None else f"{owner}: "
        raise FrameError(f"{named}unusable intrinsics fx={fx:g} fy={fy:g} cx={cx:g} cy={cy:g}")
    return values.astype(np.float32)
