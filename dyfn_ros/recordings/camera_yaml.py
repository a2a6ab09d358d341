"""camera_info YAML files, as camera_calibration writes and camera drivers read them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.typestore import Lens


@dataclass(frozen=True)
class CameraYaml:
    """matrix: 3 x 3 float64 pixels of an image of size (H, W). lens: None without distortion."""

    matrix: np.ndarray
    lens: Lens | None
    size: tuple[int, int]


def read_camera_yaml(path: Path) -> CameraYaml:
    """Keys: image_width, image_height, camera_matrix, distortion_model, distortion_coefficients
    (the last two may be missing: no distortion).

    Raises RecordingError naming the file, the key and what was expected.
    """
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RecordingError(f"{path}: cannot be read as camera YAML: {error}") from error
    if not isinstance(content, dict):
        raise RecordingError(f"{path}: expected keys such as camera_matrix, got {content!r:.60}")
    width, height = (_positive(path, content, key) for key in ("image_width", "image_height"))
    matrix = _numbers(path, content, "camera_matrix", 9).reshape(3, 3)
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise RecordingError(f"{path}: camera_matrix: focal lengths must be positive: {matrix}")
    lens = None
    if content.get("distortion_coefficients") is not None:
        values = tuple(_numbers(path, content, "distortion_coefficients").tolist())
        lens = Lens(str(content.get("distortion_model", "plumb_bob")), values)
        lens = lens if any(values) else None
    return CameraYaml(matrix, lens, (height, width))


def _positive(path: Path, content: dict[str, Any], key: str) -> int:
    value = content.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise RecordingError(f"{path}: {key}: expected pixels, got {value!r}")
    return value


def _numbers(path: Path, content: dict[str, Any], key: str, count: int | None = None) -> np.ndarray:
    entry = content.get(key)
    data = entry.get("data") if isinstance(entry, dict) else entry
    try:
        values = np.array(data, np.float64).reshape(-1)
    except (TypeError, ValueError):
        values = np.array([np.nan])
    if not np.isfinite(values).all() or count not in (None, len(values)):
        wanted = "numbers" if count is None else f"{count} numbers"
        raise RecordingError(f"{path}: {key}: expected `data` of {wanted}, got {entry!r:.80}")
    return values
