"""ROS messages <-> arrays, both ways, without cv_bridge.

The functions read any object with the fields of the ROS type: rclpy messages and the ones that
rosbags deserialises. ROS itself is imported only where a message for it is built.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dyfn_ros.messages.encodings import (
    FULL_BITS,
    MessageError,
    Raster,
    decode_colour,
    decode_metric_depth,
)
from dyfn_ros.messages.picture_size import MAX_PIXELS, check_pixels

__all__ = [
    "MessageError",
    "colour_message",
    "compressed_message",
    "decode_depth",
    "decode_image",
    "depth_fields",
    "depth_message",
    "normal_message",
]


def _raster(message: Any, bits: int = FULL_BITS) -> Raster:
    return Raster(
        data=_bytes(message.data),
        height=int(message.height),
        width=int(message.width),
        encoding=str(message.encoding),
        step=int(message.step),
        big_endian=bool(message.is_bigendian),
        bits=bits,
    )


def _bytes(data: Any) -> np.ndarray:
    """array.array, bytes or numpy array of bytes -> 1-D uint8 without a copy."""
    return np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)


def decode_image(message: Any, most: int = MAX_PIXELS, bits: int = FULL_BITS) -> np.ndarray:
    """sensor_msgs/Image -> H x W x 3 uint8 RGB.

    bits: of the values of 16-bit encodings. Raises MessageError (see decode_colour), also for more
    pixels than `most`.
    """
    check_pixels(int(message.width), int(message.height), most)
    return decode_colour(_raster(message, bits))


def decode_depth(
    message: Any, *, zero: bool = False, full: bool = False, scale: float | None = None
) -> np.ndarray:
    """sensor_msgs/Image with depth -> H x W float32 metres, NaN invalid. Raises MessageError.

    zero, full, scale: see decode_metric_depth.
    """
    return decode_metric_depth(_raster(message), zero=zero, full=full, scale=scale)


def depth_fields(depth: np.ndarray, valid: np.ndarray, encoding: str = "32FC1") -> dict[str, Any]:
    """H x W depth and validity -> the fields of an Image but the header.

    encoding: 32FC1, NaN invalid; or 16UC1, thousandths of the unit, 0 invalid (also what is
    nearer than half a thousandth or beyond 65.535). `data` is a 1-D uint8 array.
    """
    values = _thousandths(depth, valid) if encoding == "16UC1" else _floats(depth, valid)
    height, width = values.shape
    return {
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": values.itemsize * width,
        "data": values.reshape(-1).view(np.uint8),
    }


def _floats(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.where(valid, depth, np.nan).astype("<f4")


def _thousandths(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    rounded = np.rint(np.where(valid, depth, 0) * 1000.0)
    return np.where(rounded <= 65535, rounded, 0).astype("<u2")


def _octets(values: np.ndarray) -> memoryview:
    """For `message.data.frombytes`: the setter of `data` may look at, or copy, every element."""
    return np.ascontiguousarray(values).reshape(-1).view(np.uint8).data


def depth_message(
    header: Any, depth: np.ndarray, valid: np.ndarray, encoding: str = "32FC1"
) -> Any:
    """-> sensor_msgs.msg.Image, see depth_fields; header as it is."""
    return _image(header, depth_fields(depth, valid, encoding))


def colour_message(header: Any, rgb: np.ndarray) -> Any:
    """H x W x 3 uint8 RGB -> sensor_msgs.msg.Image, rgb8; header as it is."""
    height, width = rgb.shape[:2]
    fields = {"height": height, "width": width, "encoding": "rgb8", "step": 3 * width}
    return _image(header, {**fields, "data": rgb})


def normal_message(header: Any, normal: np.ndarray, valid: np.ndarray) -> Any:
    """H x W x 3 unit normals -> sensor_msgs.msg.Image, 32FC3, NaN where not valid."""
    height, width = normal.shape[:2]
    values = np.where(valid[..., None], normal, np.nan).astype("<f4")
    fields = {"height": height, "width": width, "encoding": "32FC3", "step": 12 * width}
    return _image(header, {**fields, "is_bigendian": 0, "data": values})


def _image(header: Any, fields: dict[str, Any]) -> Any:
    from sensor_msgs.msg import Image

    message = Image(header=header)
    for name, value in fields.items():
        if name == "data":
            message.data.frombytes(_octets(value))
        else:
            setattr(message, name, value)
    return message


def compressed_message(header: Any, layout: str, data: bytes) -> Any:
    """-> sensor_msgs.msg.CompressedImage; layout is its `format`."""
    from sensor_msgs.msg import CompressedImage

    message = CompressedImage(header=header, format=layout)
    message.data.frombytes(data)
    return message
