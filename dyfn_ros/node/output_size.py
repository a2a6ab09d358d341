"""What a camera of fewer pixels would have seen, for outputs that are smaller than the image."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from dyfn_core.prediction import Prediction
from dyfn_ros.messages.camera_info import resized_camera_info, resized_matrix


def smaller(
    prediction: Prediction[np.ndarray], image: np.ndarray, info: Any, scale: float
) -> tuple[Prediction[np.ndarray], np.ndarray, Any]:
    """Prediction, H x W x 3 image and CameraInfo (or None) of an image of `scale` times the size.

    A pixel takes the depth at its centre, so that no depth is made up between two surfaces; its
    point lies on its own ray.
    """
    height, width = prediction.depth.shape
    rows, columns = _centres(height, scale), _centres(width, scale)
    if (len(rows), len(columns)) == (height, width):
        return prediction, image, info
    grid = np.ix_(rows, columns)
    depth = prediction.depth[grid]
    matrix = resized_matrix(prediction.camera_matrix, (len(columns) / width, len(rows) / height))
    x = (np.arange(len(columns)) - matrix[0, 2]) / matrix[0, 0]
    y = (np.arange(len(rows)) - matrix[1, 2]) / matrix[1, 1]
    rays = np.ones((*depth.shape, 3), np.float32)
    rays[..., 0], rays[..., 1] = x, y[:, None]
    small = replace(
        prediction,
        depth=depth,
        points=rays * depth[..., None],
        mask=prediction.mask[grid],
        known_camera=matrix,
        disparity=None,
        withheld=None,
        normal=None if prediction.normal is None else prediction.normal[grid],
    )
    if info is not None:
        info = resized_camera_info(info, len(rows), len(columns))
    return small, image[grid], info


def _centres(length: int, scale: float) -> np.ndarray:
    """Indices of the pixels at the centres of fewer, evenly spaced ones."""
    count = max(1, round(length * scale))
    centres: np.ndarray = ((2 * np.arange(count) + 1) * length) // (2 * count)
    return centres
