"""ROS messages <-> arrays, both ways, without cv_bridge.

The functions read any object with the fields of the ROS type: rclpy messages and the ones that
rosbags deserialises. ROS itself is imported only where a message for it is built.
"""

from __future__ import annotations

import array
from dataclasses import dataclass
from typing import Any

import numpy as np

from dyfn_ros.encodings import MessageError, Raster, decode_colour, decode_metric_depth

__all__ = [
    "CLOUD_DTYPE",
    "Calibration",
    "MessageError",
    "camera_info_message",
    "cloud_message",
    "cloud_points",
    "colour_message",
    "compressed_message",
    "decode_camera_info",
    "decode_depth",
    "decode_image",
    "depth_fields",
    "depth_message",
    "pack_cloud",
]

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


def _raster(message: Any) -> Raster:
    return Raster(
        data=_bytes(message.data),
        height=int(message.height),
        width=int(message.width),
        encoding=str(message.encoding),
        step=int(message.step),
        big_endian=bool(message.is_bigendian),
    )


def _bytes(data: Any) -> np.ndarray:
    """array.array, bytes or numpy array of bytes -> 1-D uint8 without a copy."""
    return np.frombuffer(data, np.uint8) if len(data) else np.empty(0, np.uint8)


def decode_image(message: Any) -> np.ndarray:
    """sensor_msgs/Image -> H x W x 3 uint8 RGB. Raises MessageError (see decode_colour)."""
    return decode_colour(_raster(message))


def decode_depth(message: Any, *, zero: bool = False) -> np.ndarray:
    """sensor_msgs/Image with depth -> H x W float32 metres, NaN invalid. Raises MessageError.

    zero: see decode_metric_depth.
    """
    return decode_metric_depth(_raster(message), zero=zero)


@dataclass(frozen=True)
class Calibration:
    """What a CameraInfo says about one image.

    matrix: 3 x 3 float64, pixels of the image at hand (binning and region of interest applied).
    model: name of the lens model. d: its coefficients; empty for rectified images.
    """

    matrix: np.ndarray
    model: str = ""
    d: tuple[float, ...] = ()

    @property
    def distorted(self) -> bool:
        """Whether the lens model is more than a pinhole."""
        return any(self.d)


def _window(info: Any) -> tuple[int, int, int, int]:
    """x, y, width, height of the image on the full sensor, before binning."""
    roi = info.roi
    if roi.width and roi.height:
        return int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)
    return 0, 0, int(info.width), int(info.height)


def decode_camera_info(
    info: Any, height: int, width: int, *, rectified: bool = False
) -> Calibration:
    """sensor_msgs/CameraInfo -> the intrinsics of an image of height x width pixels.

    rectified: take P, which describes rectified images, instead of K.
    Raises MessageError: uncalibrated (K[0] == 0), no pinhole matrix, another size than the image.
    """
    k = _field(info, "k")
    matrix = np.array(k, np.float64).reshape(3, 3)
    if rectified:
        matrix = np.array(_field(info, "p"), np.float64).reshape(3, 4)[:, :3].copy()
    if matrix[0, 0] == 0:
        raise MessageError(f"uncalibrated: {'P' if rectified else 'K'}[0] is 0")
    pinhole = [[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]]
    usable = np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0
    if not usable or not np.array_equal(matrix, pinhole):
        raise MessageError(f"no pinhole camera matrix [fx 0 cx; 0 fy cy; 0 0 1]: {matrix.tolist()}")
    x, y, w, h = _window(info)
    bin_x, bin_y = max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    if (h // bin_y, w // bin_x) != (height, width):
        raise MessageError(
            f"is for {w // bin_x} x {h // bin_y} pixels, but the images have {width} x {height}"
        )
    matrix[0, 2] = (matrix[0, 2] - x + 0.5) / bin_x - 0.5
    matrix[1, 2] = (matrix[1, 2] - y + 0.5) / bin_y - 0.5
    matrix[0, :2] /= bin_x
    matrix[1, 1] /= bin_y
    d = () if rectified else tuple(float(value) for value in _field(info, "d"))
    return Calibration(matrix, str(info.distortion_model), d)


def _field(info: Any, name: str) -> Any:
    """ROS 2 says k and p, ROS 1 recordings say K and P."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def valid_depth(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """H x W bool: where depth is finite, in front of the camera, and the model believes in it."""
    return mask & np.isfinite(depth) & (depth > 0)


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


def _ros_bytes(values: np.ndarray) -> array.array:
    """Only an array.array is taken over by rclpy without a look at every element."""
    data = array.array("B")
    data.frombytes(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)
    return data


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


def _image(header: Any, fields: dict[str, Any]) -> Any:
    from sensor_msgs.msg import Image

    message = Image(header=header)
    for name, value in fields.items():
        setattr(message, name, _ros_bytes(value) if name == "data" else value)
    return message


def compressed_message(header: Any, layout: str, data: bytes) -> Any:
    """-> sensor_msgs.msg.CompressedImage; layout is its `format`."""
    from sensor_msgs.msg import CompressedImage

    message = CompressedImage(header=header, format=layout)
    message.data = _ros_bytes(np.frombuffer(data, np.uint8))
    return message


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


def camera_info_message(header: Any, matrix: np.ndarray, height: int, width: int) -> Any:
    """A pinhole camera of height x width pixels -> sensor_msgs.msg.CameraInfo.

    matrix: 3 x 3, pixels.
    """
    from sensor_msgs.msg import CameraInfo

    k = np.asarray(matrix, np.float64)
    return CameraInfo(
        header=header,
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=[0.0] * 5,
        k=k.reshape(-1).tolist(),
        r=np.eye(3).reshape(-1).tolist(),
        p=np.column_stack([k, np.zeros(3)]).reshape(-1).tolist(),
    )
