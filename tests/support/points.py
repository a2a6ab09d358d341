"""Point clouds as messages."""

from __future__ import annotations

import array

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField


def cloud_message(points: np.ndarray, stamp: tuple[int, int], frame_id: str = "") -> PointCloud2:
    """points: N x 3, metres. stamp: seconds and nanoseconds."""
    fields = [
        PointField(name=axis, offset=4 * i, datatype=7, count=1) for i, axis in enumerate("xyz")
    ]
    message = PointCloud2(height=1, width=len(points), fields=fields, point_step=12)
    message.row_step = 12 * len(points)
    message.data = array.array("B", points.astype("<f4").tobytes())
    message.header.frame_id = frame_id
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    return message
