"""Frame after frame out of .npy and .npz files, without reading them whole."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from dyfn_core.data.frames import FrameError

Shape = tuple[int, int, int]
_VERSIONS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


def npz_key(path: Path, preferred: Sequence[str]) -> str | None:
    """Which array of an .npz file to take: the only one, or the first of `preferred` in it.

    None for an .npy file. Raises FrameError naming the keys that are there.
    """
    if path.suffix == ".npy":
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            keys = [name.removesuffix(".npy") for name in archive.namelist()]
    except (OSError, zipfile.BadZipFile) as error:
        raise FrameError(f"{path}: no readable .npz file: {error}") from error
    found = next((key for key in preferred if key in keys), None)
    if found is None:
        if len(keys) != 1:
            raise FrameError(
                f"{path}: expected one array, or one of the keys {', '.join(preferred)}; "
                f"found {', '.join(keys) or 'none'}"
            )
        found = keys[0]
    return found


def frames_of_array(path: Path, key: str | None) -> tuple[Shape, Iterator[np.ndarray]]:
    """(T, H, W) of an array T x H x W, T x 1 x H x W, T x H x W x 1 or H x W (one frame), and its
    frames, each H x W, read one at a time.

    Raises FrameError: unreadable, another shape, no real numbers, or shorter than its header says.
    """
    with _opened(path, key) as file:
        shape, dtype, fortran = _header(file, path)
    if fortran and len(shape) > 1:
        raise FrameError(f"{path}: the array is in Fortran order; save it in C order")
    if dtype.kind not in "fiu":
        raise FrameError(f"{path}: expected an array of numbers, got {dtype}")
    size = _frames_shape(shape, path)
    return size, _frames(path, key, size, dtype)


def _frames_shape(shape: tuple[int, ...], path: Path) -> Shape:
    if len(shape) == 4 and shape[1] == 1:
        shape = (shape[0], shape[2], shape[3])
    elif len(shape) == 4 and shape[3] == 1:
        shape = shape[:3]
    elif len(shape) == 2:
        shape = (1, *shape)
    if len(shape) != 3:
        raise FrameError(f"{path}: expected T x H x W (or T x 1 x H x W), got {shape}")
    return shape[0], shape[1], shape[2]


def _frames(path: Path, key: str | None, size: Shape, dtype: np.dtype[Any]) -> Iterator[np.ndarray]:
    count, height, width = size
    wanted = height * width * dtype.itemsize
    with _opened(path, key) as file:
        _header(file, path)
        for index in range(count):
            try:
                data = file.read(wanted)
            except (OSError, zipfile.BadZipFile, EOFError, ValueError) as error:
                raise FrameError(f"{path}: frame {index} cannot be read: {error}") from error
            if len(data) != wanted:
                raise FrameError(f"{path}: ends within frame {index} of {count}")
            yield np.frombuffer(data, dtype).reshape(height, width)


def _header(file: IO[bytes], path: Path) -> tuple[tuple[int, ...], np.dtype[Any], bool]:
    try:
        version = npy.read_magic(file)
        shape, fortran, dtype = _VERSIONS[version](file)
    except (ValueError, KeyError, OSError, EOFError) as error:
        raise FrameError(f"{path}: no readable numpy array: {error!r}") from error
    return shape, dtype, fortran


def _opened(path: Path, key: str | None) -> IO[bytes]:
    try:
        if key is None:
            return path.open("rb")
        return zipfile.ZipFile(path).open(f"{key}.npy")
    except (OSError, KeyError, zipfile.BadZipFile) as error:
        raise FrameError(f"{path}: cannot be read: {error}") from error
