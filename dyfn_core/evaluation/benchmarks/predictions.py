"""Depth of any method, from files: numpy, 16-bit PNG or OpenEXR, one a frame or one a sequence."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from dyfn_core.data.files import read_exr, read_uint16
from dyfn_core.data.frames import DataError, FrameError
from dyfn_core.evaluation.benchmarks.arrays import frames_of_array, npz_key
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkFrame, BenchmarkSequence
from dyfn_core.quantities import DISPARITY, scored_quantity, scored_values

ARRAYS = (".npz", ".npy")
FRAME_FILES = (".npz", ".npy", ".png", ".exr")
KEYS = ("depth", "disparity", "inverse", "prediction", "arr_0")

Predict = Callable[[int, BenchmarkFrame], Mapping[str, np.ndarray]]
OpenArrays = Callable[[BenchmarkSequence], Iterator[np.ndarray]]


class Method(Protocol):
    """What can be scored: one or several predictions of each frame.

    quantity: "depth" (scored after scale and shift in depth) or "disparity" (scale and shift in
    disparity). variants: the predictions' names, the rows of a table. in_metres: those of them that
    are in metres, or may be. seconds: what every frame
    so far took, by variant, where the method was run here; empty for files.
    """

    @property
    def quantity(self) -> str: ...

    @property
    def variants(self) -> tuple[str, ...]: ...

    @property
    def in_metres(self) -> tuple[str, ...]: ...

    @property
    def seconds(self) -> Mapping[str, Sequence[float]]: ...

    def open(self, sequence: BenchmarkSequence) -> Predict:
        """Begin a sequence; the result takes its frames in order and gives H x W float arrays by
        variant, NaN where a variant says nothing, of the truth's field of view at any size."""


@dataclass(frozen=True)
class ArrayMethod:
    """A method whose predictions come as an iterator of H x W arrays per sequence.

    open_arrays: sequence -> one array per scored frame, in order; what is not finite or not
    positive (disparity: negative) counts as no prediction. quantity: one of QUANTITIES; "inverse"
    is 1 / depth without an unknown offset and is inverted here, "disparity" is a / depth + b.
    """

    name: str
    kind: str
    open_arrays: OpenArrays

    def __post_init__(self) -> None:
        try:
            scored_quantity(self.kind)
        except ValueError as error:
            raise DataError(str(error)) from error

    @property
    def quantity(self) -> str:
        """See Method."""
        return scored_quantity(self.kind)

    @property
    def variants(self) -> tuple[str, ...]:
        """See Method."""
        return (self.name,)

    @property
    def in_metres(self) -> tuple[str, ...]:
        """See Method."""
        return () if self.quantity == DISPARITY else self.variants

    @property
    def seconds(self) -> Mapping[str, Sequence[float]]:
        """See Method."""
        return {}

    def open(self, sequence: BenchmarkSequence) -> Predict:
        """See Method. The result raises FrameError when the arrays end too early."""
        arrays = iter(self.open_arrays(sequence))

        def predict(index: int, frame: BenchmarkFrame) -> dict[str, np.ndarray]:
            values = next(arrays, None)
            if values is None:
                raise FrameError(
                    f"{sequence.name}: {self.name} ends after {index} of {len(sequence)} frames"
                )
            return {self.name: scored_values(values, self.kind)}

        return predict


@dataclass(frozen=True)
class PredictionFolder:
    """Arrays of predictions below one folder.

    For a sequence S: S.npz or S.npy (T x H x W), or a folder S with one .npz, .npy, .png or .exr a
    frame; "/" in S may be "_" in the file's name. There must be as many as scored frames, or as
    frames of the whole sequence (the scored ones are then taken out), or files whose numbers are
    the frames' numbers.

    scale: stored values per unit, for 16-bit PNG needed (0 is then no prediction). key: of .npz
    files with several arrays.
    """

    root: Path
    scale: float | None = None
    key: str | None = None

    def arrays(self, sequence: BenchmarkSequence) -> Iterator[np.ndarray]:
        """One H x W array per scored frame. Raises DataError or FrameError, naming the file."""
        if self.scale is not None and not self.scale > 0:
            raise DataError(f"scale must be positive, got {self.scale}")
        for name in dict.fromkeys((sequence.name, sequence.name.replace("/", "_"))):
            for suffix in ARRAYS:
                path = self.root / f"{name}{suffix}"
                if path.is_file():
                    return self._of_sequence(path, sequence)
            if (self.root / name).is_dir():
                return self._of_frames(self.root / name, sequence)
        raise DataError(
            f"{self.root}: no predictions of {sequence.name}: expected {sequence.name}.npz, "
            f"{sequence.name}.npy or a folder {sequence.name}/ with one file a frame"
        )

    def _of_sequence(self, path: Path, sequence: BenchmarkSequence) -> Iterator[np.ndarray]:
        (count, _, _), frames = frames_of_array(path, self._key(path))
        wanted = _places(count, sequence, path)
        return self._scaled(frame for place, frame in enumerate(frames) if place in wanted)

    def _of_frames(self, folder: Path, sequence: BenchmarkSequence) -> Iterator[np.ndarray]:
        files = [path for path in folder.iterdir() if path.suffix.lower() in FRAME_FILES]
        kinds = sorted({path.suffix.lower() for path in files})
        if len(kinds) > 1:
            raise DataError(f"{folder}: expected files of one kind, found {', '.join(kinds)}")
        by_number = {_number(path): path for path in files}
        if len(by_number) == len(files) and set(sequence.numbers) <= set(by_number):
            chosen = [by_number[number] for number in sequence.numbers]
        else:
            ordered = [path for _, path in sorted((_number(path), path) for path in files)]
            wanted = _places(len(ordered), sequence, folder)
            chosen = [path for place, path in enumerate(ordered) if place in wanted]
        return self._scaled(self._read(path) for path in chosen)

    def _read(self, path: Path) -> np.ndarray:
        suffix = path.suffix.lower()
        if suffix == ".exr":
            return read_exr(path)
        if suffix == ".png":
            if self.scale is None:
                raise DataError(
                    f"{path}: 16-bit PNG needs a scale (stored values per unit, 1000 for mm)"
                )
            stored = read_uint16(path).astype(np.float32)
            return np.where(stored > 0, stored, np.float32(np.nan))
        (count, height, width), frames = frames_of_array(path, self._key(path))
        if count != 1:
            raise FrameError(f"{path}: expected one frame, got {count} of {height} x {width}")
        return next(frames)

    def _key(self, path: Path) -> str | None:
        if self.key is None or path.suffix == ".npy":
            return npz_key(path, KEYS)
        found = npz_key(path, (self.key,))
        if found != self.key:
            raise FrameError(f"{path}: expected the key {self.key}, found {found}")
        return found

    def _scaled(self, frames: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
        factor = np.float32(1 if self.scale is None else 1 / self.scale)
        return (frame.astype(np.float32) * factor for frame in frames)


def _number(path: Path) -> float:
    """The last number in a file's name: a frame's number, or a stamp."""
    found = re.findall(r"\d+(?:\.\d+)?", path.stem)
    return float(found[-1]) if found else float("inf")


def _places(count: int, sequence: BenchmarkSequence, path: Path) -> set[int]:
    """Which of `count` predictions in order belong to the scored frames."""
    if count == len(sequence):
        return set(range(count))
    if count == sequence.available:
        scored = set(sequence.numbers)
        return {place for place, number in enumerate(sequence.source.numbers) if number in scored}
    raise DataError(
        f"{path}: {count} predictions for {sequence.name}, expected {len(sequence)} (the scored "
        f"frames) or {sequence.available} (all frames)"
    )
