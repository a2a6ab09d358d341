"""Organised point clouds: arrays to sensor_msgs/PointCloud2 and back."""

from __future__ import annotations

import array
from typing import Any

import cv2
import numpy as np

from dyfn_ros.messages.encodings import MessageError
from dyfn_ros.messages.images import _bytes, _octets

# PCL's PointXYZRGB: colour at 16, so that x y z keep four floats to themselves.
CLOUD_OFFSETS = {"x": 0, "y": 4, "z": 8, "rgb": 16}
CLOUD_STEP = 32


def _layout(offsets: dict[str, int], step: int) -> np.dtype[np.void]:
    return np.dtype(
        {
            "names": list(offsets),
            "formats": ["<f4"] * 4,
            "offsets": list(offsets.values()),
            "itemsize": step,
        }
    )


CLOUD_DTYPE = _layout(CLOUD_OFFSETS, CLOUD_STEP)
COMPACT_DTYPE = _layout({**CLOUD_OFFSETS, "rgb": 12}, 16)
_FLOAT32 = 7  # sensor_msgs/PointField


class CloudMemory:
    """Memory for clouds, one after the other: fresh pages for each cost more than the points.

    A cloud is good until the next one is packed into the same memory.
    """

    def __init__(self) -> None:
        self.data = array.array("B")
        self._cloud: np.ndarray = np.empty((0, 0), CLOUD_DTYPE)
        self._message: Any = None

    def cloud(self, shape: tuple[int, ...], dtype: np.dtype[np.void]) -> np.ndarray:
        """H x W of dtype, whose padding is zero and whose points are those of the cloud before."""
        if self._cloud.shape != shape or self._cloud.dtype != dtype:
            self.data = array.array("B", bytes(dtype.itemsize * shape[0] * shape[1]))
            self._cloud = _bytes(self.data).view(dtype).reshape(shape)
            self._message = None
        return self._cloud

    def message(self, header: Any) -> Any:
        """The cloud as a PointCloud2 without a copy, the same message while the layout stays."""
        if self._message is None:
            self._message = message = _layout_message(self._cloud)
            message.data.frombytes(self.data)  # its setter may copy, and later clouds go here
            self.data = message.data
            self._cloud = _bytes(self.data).view(self._cloud.dtype).reshape(self._cloud.shape)
        self._message.header = header
        return self._message


def pack_cloud(
    points: np.ndarray,
    valid: np.ndarray,
    image: np.ndarray,
    dtype: np.dtype[np.void] = CLOUD_DTYPE,
    memory: CloudMemory | None = None,
) -> np.ndarray:
    """Organised cloud: H x W of dtype.

    points: H x W x 3, optical frame. valid: H x W bool; the others become NaN.
    image: H x W x 3 uint8 RGB, packed as 0x00RRGGBB into the bits of a float.
    memory: where to; None: memory of its own.
    """
    cloud = (memory or CloudMemory()).cloud(valid.shape, dtype)
    if not cloud.size:
        return cloud
    step, colour = dtype.itemsize, dtype.fields["rgb"][1]  # type: ignore[index]
    octets = cloud.view(np.uint8).reshape(*valid.shape, step)
    floats = octets.view("<f4")
    xyz = np.ascontiguousarray(points, "<f4")
    rgb = np.ascontiguousarray(image)
    cv2.mixChannels([xyz], [floats], [0, 0, 1, 1, 2, 2])
    cv2.mixChannels([rgb], [octets], [0, colour + 2, 1, colour + 1, 2, colour])
    invalid = np.flatnonzero(~valid)
    if invalid.size:
        floats.reshape(-1, step // 4)[invalid, :3] = np.nan
    return cloud


def cloud_points(message: Any) -> np.ndarray:
    """An organised PointCloud2 of ours -> height x width of CLOUD_DTYPE or COMPACT_DTYPE.

    Raises MessageError when the layout is another one.
    """
    layout = [(f.name, int(f.offset), int(f.datatype)) for f in message.fields]
    found = [
        dtype
        for dtype in (CLOUD_DTYPE, COMPACT_DTYPE)
        if layout == _fields(dtype) and message.point_step == dtype.itemsize
    ]
    if not found or message.is_bigendian:
        raise MessageError(
            f"cloud layout {layout}, step {message.point_step}; expected {_fields(CLOUD_DTYPE)} "
            f"and {CLOUD_DTYPE.itemsize}, or {_fields(COMPACT_DTYPE)} and {COMPACT_DTYPE.itemsize}"
        )
    (dtype,), step = found, found[0].itemsize
    height, width = int(message.height), int(message.width)
    data = _bytes(message.data)
    if message.row_step != step * width or data.size != step * width * height:
        raise MessageError(f"cloud of {width} x {height} points has {data.size} bytes")
    return data.view(dtype).reshape(height, width)


def _fields(dtype: np.dtype[np.void]) -> list[tuple[str, int, int]]:
    assert dtype.fields is not None
    return [(name, offset, _FLOAT32) for name, (_, offset, *_) in dtype.fields.items()]


def cloud_message(header: Any, cloud: np.ndarray, memory: CloudMemory | None = None) -> Any:
    """-> sensor_msgs.msg.PointCloud2; header as it is.

    cloud: as pack_cloud returns it. memory: that it was packed into; the message is then its own,
    without a copy, and good as long as the cloud.
    """
    if memory is not None:
        return memory.message(header)
    message = _layout_message(cloud)
    message.header = header
    message.data.frombytes(_octets(cloud))
    return message


def _layout_message(cloud: np.ndarray) -> Any:
    """All of a PointCloud2 that does not change from frame to frame."""
    from sensor_msgs.msg import PointCloud2, PointField

    height, width = cloud.shape
    step = cloud.dtype.itemsize
    fields = [
        PointField(name=name, offset=offset, datatype=kind, count=1)
        for name, offset, kind in _fields(cloud.dtype)
    ]
    message = PointCloud2(height=height, width=width, fields=fields)
    message.point_step = step
    message.row_step = step * width
    message.is_bigendian = False
    message.is_dense = False
    return message
