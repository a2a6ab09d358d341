"""RGB-D folders in many layouts and namings, whose pixels tell which frame they are of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

SIZE = (48, 64)
MATRIX = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])


def shade(frame: int) -> int:
    """What every pixel of a frame's colour image is, nearly: JPEG rounds."""
    return 10 + 8 * frame


def metres(frame: int) -> np.ndarray:
    """Depth of a frame: from 1 + frame to 1.45 + frame."""
    ramp = np.linspace(0, 0.45, SIZE[1], dtype=np.float32)
    return np.tile(1 + frame + ramp, (SIZE[0], 1))


def frame_of(image: np.ndarray) -> int:
    """Which frame a colour image is of."""
    return round((float(image.mean()) - 10) / 8)


def depth_frame_of(depth: np.ndarray) -> int:
    """Which frame a depth image in metres is of."""
    return int(np.floor(np.nanmin(depth))) - 1


def write(path: Path, pixels: np.ndarray) -> None:
    """A picture of the type that the suffix says, whatever its case."""
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(path.suffix.lower(), pixels)
    assert done
    path.write_bytes(data.tobytes())


def write_folder(
    folder: Path,
    colours: Sequence[str],
    depths: Sequence[str],
    unit: float = 1000,
    size: tuple[int, int] = SIZE,
) -> Path:
    """rgb/ and depth/ with these names, of frames 0, 1, 2 ..., and K.txt."""
    for frame, name in enumerate(colours):
        write(folder / "rgb" / name, np.full((*size, 3), shade(frame), np.uint8))
    for frame, name in enumerate(depths):
        stored = np.round(metres(frame) * unit).astype(np.uint16)
        write(folder / "depth" / name, cv2.resize(stored, size[::-1], interpolation=0))
    np.savetxt(folder / "K.txt", MATRIX)
    return folder
