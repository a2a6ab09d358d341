"""ROS messages for recordings, made of arrays without a ROS installation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TYPES = get_typestore(Stores.ROS2_JAZZY)
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
POSE = "geometry_msgs/msg/PoseStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
FLOAT = "std_msgs/msg/Float64"
COMPRESSED_VIDEO = "foxglove_msgs/msg/CompressedVideo"
FFMPEG_PACKET = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
FOXGLOVE_RAW = "foxglove_msgs/msg/RawImage"
FOXGLOVE_COMPRESSED = "foxglove_msgs/msg/CompressedImage"
FOXGLOVE_CALIBRATION = "foxglove_msgs/msg/CameraCalibration"
_OTHERS = {  # fields of messages that are not of ROS itself
    COMPRESSED_VIDEO: "builtin_interfaces/Time timestamp, string frame_id, uint8[] data, "
    "string format",
    FOXGLOVE_RAW: "builtin_interfaces/Time timestamp, string frame_id, uint32 width, "
    "uint32 height, string encoding, uint32 step, uint8[] data",
    FOXGLOVE_COMPRESSED: "builtin_interfaces/Time timestamp, string frame_id, uint8[] data, "
    "string format",
    FOXGLOVE_CALIBRATION: "builtin_interfaces/Time timestamp, string frame_id, uint32 width, "
    "uint32 height, string distortion_model, float64[] d, float64[9] k, float64[9] r, "
    "float64[12] p",
    FFMPEG_PACKET: "std_msgs/Header header, int32 width, int32 height, string encoding, "
    "uint64 pts, uint8 flags, bool is_bigendian, uint8[] data",
}
for _kind, _fields in _OTHERS.items():
    TYPES.register(get_types_from_msg(_fields.replace(", ", "\n"), _kind))


@dataclass(frozen=True)
class Lens:
    """model: plumb_bob, rational_polynomial or equidistant. coefficients: as CameraInfo.d."""

    model: str
    coefficients: tuple[float, ...]


def header(stamp_ns: int, frame_id: str) -> Any:
    """A std_msgs Header."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = _new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def camera_info(
    camera_matrix: np.ndarray,
    size: tuple[int, int],
    stamp_ns: int,
    frame_id: str,
    lens: Lens | None = None,
) -> Any:
    """A CameraInfo: K and P from the 3 x 3 matrix; D zero unless there is a lens."""
    matrix = np.asarray(camera_matrix, np.float64)
    lens = lens or Lens("plumb_bob", (0.0,) * 5)
    arrays = {
        "d": np.array(lens.coefficients, np.float64),
        "k": matrix.reshape(9),
        "r": np.eye(3).reshape(9),
        "p": np.hstack([matrix, np.zeros((3, 1))]).reshape(12),
    }
    return calibration_message(header(stamp_ns, frame_id), size, lens.model, arrays)


def calibration_message(
    head: Any, size: tuple[int, int], model: str, arrays: dict[str, np.ndarray]
) -> Any:
    """A CameraInfo of the whole sensor; arrays: float64 d, k (9), r (9) and p (12)."""
    return _new(
        CAMERA_INFO,
        header=head,
        height=size[0],
        width=size[1],
        distortion_model=model,
        **arrays,
        binning_x=0,
        binning_y=0,
        roi=_new(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )


def _new(kind: str, **fields: Any) -> Any:
    return TYPES.types[kind](**fields)


def image_message(pixels: np.ndarray, encoding: str, stamp_ns: int, frame_id: str) -> Any:
    """A raw Image of H x W (x C) pixels, whose dtype must be that of the encoding."""
    pixels = np.ascontiguousarray(pixels)
    data, size = pixels.view(np.uint8).reshape(-1), (pixels.shape[0], pixels.shape[1])
    return raw_message(header(stamp_ns, frame_id), size, encoding, pixels.strides[0], data)


def raw_message(
    head: Any, size: tuple[int, int], encoding: str, step: int, data: np.ndarray
) -> Any:
    """A raw little-endian Image of H x W pixels; step: bytes of a row, data: 1-D uint8."""
    return _new(
        IMAGE,
        header=head,
        height=size[0],
        width=size[1],
        encoding=encoding,
        is_bigendian=0,
        step=step,
        data=data,
    )


def compressed_message(data: np.ndarray, layout: str, stamp_ns: int, frame_id: str) -> Any:
    """A CompressedImage of encoded bytes (1-D uint8)."""
    return _new(COMPRESSED_IMAGE, header=header(stamp_ns, frame_id), format=layout, data=data)


def video_message(data: np.ndarray, layout: str, stamp_ns: int, frame_id: str) -> Any:
    """A CompressedVideo of one encoded picture (1-D uint8)."""
    stamp = header(stamp_ns, frame_id).stamp
    return _new(COMPRESSED_VIDEO, timestamp=stamp, frame_id=frame_id, data=data, format=layout)


def pose_message(pose: np.ndarray, stamp_ns: int, frame_id: str) -> Any:
    """A PoseStamped of a 4 x 4 camera-to-`frame_id`."""
    return _new(POSE, header=header(stamp_ns, frame_id), pose=_pose(pose))


def _pose(pose: np.ndarray) -> Any:
    x, y, z = (float(v) for v in pose[:3, 3])
    position = _new("geometry_msgs/msg/Point", x=x, y=y, z=z)
    return _new("geometry_msgs/msg/Pose", position=position, orientation=_quaternion(pose))


@dataclass(frozen=True)
class Moved:
    """What an odometry says at one moment.

    pose: 4 x 4, points of the moving frame to the odometry's. twist: (6,) metres and radians a
    second in the moving frame, linear x, y, z, then angular. covariances: 6 x 6 of both.
    """

    pose: np.ndarray
    twist: np.ndarray
    pose_covariance: np.ndarray
    twist_covariance: np.ndarray


def odometry_message(moved: Moved, stamp_ns: int, parent: str, child: str) -> Any:
    """An Odometry of the frame `child` in the frame `parent`."""
    linear, angular = (
        _new("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))
        for x, y, z in (moved.twist[:3], moved.twist[3:])
    )
    twist = _new("geometry_msgs/msg/Twist", linear=linear, angular=angular)
    covariances = (moved.pose_covariance, moved.twist_covariance)
    of_pose, of_twist = (np.asarray(c, np.float64).reshape(36) for c in covariances)
    return _new(
        ODOMETRY,
        header=header(stamp_ns, parent),
        child_frame_id=child,
        pose=_new(
            "geometry_msgs/msg/PoseWithCovariance", pose=_pose(moved.pose), covariance=of_pose
        ),
        twist=_new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=of_twist),
    )


def transform_message(pose: np.ndarray, stamp_ns: int, parent: str, child: str) -> Any:
    """A TFMessage of the 4 x 4 that takes points of `child` to `parent`."""
    x, y, z = (float(v) for v in pose[:3, 3])
    translation = _new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
    transform = _new(
        "geometry_msgs/msg/TransformStamped",
        header=header(stamp_ns, parent),
        child_frame_id=child,
        transform=_new(
            "geometry_msgs/msg/Transform", translation=translation, rotation=_quaternion(pose)
        ),
    )
    return _new(TF, transforms=[transform])


def depth_to_millimetres(depth: np.ndarray) -> np.ndarray:
    """H x W metres -> H x W uint16 millimetres, 0 where there is none or beyond 65.535 m."""
    millimetres = np.round(np.nan_to_num(depth.astype(np.float64), posinf=0, neginf=0) * 1000)
    representable = (millimetres > 0) & (millimetres <= np.iinfo(np.uint16).max)
    return np.where(representable, millimetres, 0).astype(np.uint16)


def _quaternion(pose: np.ndarray) -> Any:
    x, y, z, w = quaternion_from_matrix(pose[:3, :3])
    return _new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def quaternion_from_matrix(rotation: np.ndarray) -> tuple[float, float, float, float]:
    """3 x 3 rotation -> unit quaternion (x, y, z, w) with w >= 0.

    The eigenvector of Bar-Itzhack's symmetric 4 x 4 matrix: exact for a rotation, and the
    nearest one for a matrix with rounding errors.
    """
    r = np.asarray(rotation, np.float64)
    upper = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    x, y, z, w = np.linalg.eigh(upper)[1][:, -1]  # eigh reads the lower triangle
    sign = -1.0 if w < 0 else 1.0
    return sign * float(x), sign * float(y), sign * float(z), sign * float(w)
