"""What sensors beside FaultyPinhole's camera measure of a scene of known depth."""

from __future__ import annotations

import array
import math
from typing import Any

import numpy as np
from sensor_msgs.msg import Image, LaserScan, PointCloud2, PointField, Range

from tests.support.pinhole import FOV_X

INFRARED = 1
VIEW = 0.4  # radians of the scan, to each side
RAYS = 41


def rays(shape: tuple[int, ...]) -> np.ndarray:
    """H x W x 3 through the pixels' centres, z = 1."""
    height, width = shape
    focal = width / 2 / math.tan(math.radians(FOV_X / 2))
    v, u = np.mgrid[:height, :width]
    x, y = (u - width / 2 + 0.5) / focal, (v - height / 2 + 0.5) / focal
    return np.stack([x, y, np.ones(shape)], -1)


def cloud(points: np.ndarray) -> PointCloud2:
    """N x 3."""
    names = enumerate("xyz")
    fields = [PointField(name=axis, offset=4 * i, datatype=7, count=1) for i, axis in names]
    message = PointCloud2(height=1, width=len(points), fields=fields, point_step=12)
    message.row_step = 12 * len(points)
    message.data = array.array("B", points.astype("<f4").tobytes())
    return message


def scan(depth: np.ndarray) -> LaserScan:
    """Of the middle row."""
    height, width = depth.shape
    angles = np.linspace(-VIEW, VIEW, RAYS)
    focal = width / 2 / math.tan(math.radians(FOV_X / 2))
    columns = np.rint(width / 2 - 0.5 - focal * np.tan(angles)).astype(int)
    message = LaserScan(angle_min=-VIEW, angle_max=VIEW, angle_increment=2 * VIEW / (RAYS - 1))
    message.range_min, message.range_max = 0.05, 30.0
    message.ranges = [float(r) for r in depth[height // 2, columns] / np.cos(angles)]
    return message


def distance(metres: float) -> Range:
    """Straight ahead, in a narrow cone."""
    message = Range(radiation_type=INFRARED, field_of_view=0.01, min_range=0.05, max_range=30.0)
    message.range = float(metres)
    return message


def depth_image(depth: np.ndarray) -> Image:
    height, width = depth.shape
    message = Image(height=height, width=width, encoding="32FC1", step=4 * width)
    message.data = array.array("B", depth.astype("<f4").tobytes())
    return message


def measurement(kind: str, depth: np.ndarray) -> Any:
    """A message of this type about a scene of H x W depth, metres."""
    if kind == "PointCloud2":
        return cloud((rays(depth.shape) * depth[..., None])[2::4, 2::4].reshape(-1, 3))
    if kind == "LaserScan":
        return scan(depth)
    if kind == "Range":
        return distance(depth[depth.shape[0] // 2, depth.shape[1] // 2])
    return depth_image(depth)
