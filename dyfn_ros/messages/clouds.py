"""Organised point clouds: arrays to sensor_msgs/PointCloud2 and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from dyfn_ros.messages.encodings import MessageError
from dyfn_ros.messages.images import _bytes, _ros_bytes

# PCL's PointXYZRGB: colour at 16, so that x y z keep four floats to themselves.
CLOUD_OFFSETS = {"x": 0, "y": 4, "z": 8, "rgb": 16}


CLOUD_STEP = 32


CLOUD_DTYPE = np.dtype(
    {
        "names": list(CLOUD_OFFSETS),
        "formats": ["<f4"] * 4,
        "offsets": list(CLOUD_OFFSETS.values()),
        "itemsize": CLOUD_STEP,
    }
)


_FLOAT32 = 7  # sensor_msgs/PointField


def pack_cloud(points: np.ndarray, valid: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Organised cloud: H x W of CLOUD_DTYPE.

    points: H x W x 3, optical frame. valid: H x W bool; the others become NaN.
    image: H x W x 3 uint8 RGB, packed as 0x00RRGGBB into the bits of a float.
    """
    cloud = np.zeros(valid.shape, CLOUD_DTYPE)
    for i, axis in enumerate("xyz"):
        cloud[axis] = np.where(valid, points[..., i], np.nan)
    red, green, blue = (image[..., i].astype(np.uint32) for i in range(3))
    cloud["rgb"] = ((red << 16) | (green << 8) | blue).astype("<u4").view("<f4")
    return cloud


def cloud_points(message: Any) -> np.ndarray:
    """An organised PointCloud2 of ours -> height x width array of CLOUD_DTYPE.

    Raises MessageError when the layout is another one.
    """
    layout = [(f.name, int(f.offset), int(f.datatype)) for f in message.fields]
    expected = [(name, offset, _FLOAT32) for name, offset in CLOUD_OFFSETS.items()]
    if layout != expected or message.point_step != CLOUD_STEP or message.is_bigendian:
        raise MessageError(f"cloud layout {layout}, step {message.point_step}; expected {expected}")
    height, width = int(message.height), int(message.width)
    data = _bytes(message.data)
    if message.row_step != CLOUD_STEP * width or data.size != CLOUD_STEP * width * height:
        raise MessageError(f"cloud of {width} x {height} points has {data.size} bytes")
    return data.view(CLOUD_DTYPE).reshape(height, width)


def cloud_message(header: Any, cloud: np.ndarray) -> Any:
    """H x W of CLOUD_DTYPE -> sensor_msgs.msg.PointCloud2; header as it is."""
    from sensor_msgs.msg import PointCloud2, PointField

    height, width = cloud.shape
    fields = [
        PointField(name=name, offset=offset, datatype=_FLOAT32, count=1)
        for name, offset in CLOUD_OFFSETS.items()
    ]
    message = PointCloud2(header=header, height=height, width=width, fields=fields)
    message.point_step = CLOUD_STEP
    message.row_step = CLOUD_STEP * width
    message.is_bigendian = False
    message.is_dense = False
    message.data = _ros_bytes(cloud)
    return message
