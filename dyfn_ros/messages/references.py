"""Messages of distance sensors -> measurements in the camera's optical frame.

Reads any object with the fields of the ROS type, as images.py does.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dyfn_core.metric.pose_history import NoPose
from dyfn_core.metric.references import (
    ConeReference,
    DepthReference,
    DepthView,
    Evidence,
    PointReference,
    Reference,
)
from dyfn_ros.messages import images as messages
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.odometry import frame_name
from dyfn_ros.messages.reference_options import REFERENCE_TYPES, ReferenceOptions
from dyfn_ros.messages.transforms import TransformBuffer, TransformError

ULTRASOUND = 0  # sensor_msgs/Range.radiation_type
IMAGE = "Image"
NOT_PLACED = "sensor's place unknown"
_REMEDY = {
    False: "publish the transform or set reference_transform",
    True: "expected depth registered to the camera; if it is, set reference_transform to "
    "'0 0 0 0 0 0 1'",
}
_NO_RETURN = np.array([65.535, 65535.0])  # metres: the largest number of 16 bits, in mm and in m
_EXACT = 5e-4  # metres
_FORMATS = {7: "f4", 8: "f8"}  # sensor_msgs/PointField: FLOAT32, FLOAT64
# REP 103: a body frame (x forward, y left, z up) seen from an optical one at the same place.
_BODY_TO_OPTICAL = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


@dataclass(frozen=True)
class Transform:
    """rotation 3 x 3 and translation 3 (metres): from the sensor's frame to the optical frame."""

    rotation: np.ndarray
    translation: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """N x 3 -> N x 3."""
        moved: np.ndarray = points @ self.rotation.T + self.translation
        return moved


def parse_pose(text: str, name: str) -> Transform:
    """ "x y z qx qy qz qw" (commas allowed), a sensor's pose in the camera's optical frame.

    name: of the setting, for the error. Raises ValueError that says what was expected.
    """
    expected = f"{name} is {text!r}, expected seven numbers 'x y z qx qy qz qw'"
    try:
        values = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError as error:
        raise ValueError(expected) from error
    if len(values) != 7 or not np.isfinite(values).all():
        raise ValueError(expected)
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1) > 1e-2:
        raise ValueError(f"{expected} with a quaternion of length 1, not {norm:.3f}")
    return Transform(_rotation(values[3:] / norm), values[:3])


def parse_transform(text: str, kind: str) -> Transform:
    """The node's reference_transform, see parse_pose.

    "" is the camera's own place: optical axes for PointCloud2, those of REP 103 (x forward) for
    LaserScan and Range. A depth Image is registered to the camera: its pose can only be none.
    Raises ValueError that says what was expected.
    """
    if kind not in REFERENCE_TYPES:
        raise ValueError(f"reference_type is {kind!r}, expected one of {REFERENCE_TYPES}")
    if not text.strip():
        turned = kind in ("LaserScan", "Range")
        return Transform(_BODY_TO_OPTICAL if turned else np.eye(3), np.zeros(3))
    found = parse_pose(text, "reference_transform")
    if kind == IMAGE and not _nearly_none(found.rotation, found.translation):
        raise ValueError(
            f"reference_transform is {text!r}, but a depth Image must be registered: expected "
            "'0 0 0 0 0 0 1' or nothing"
        )
    return found


def _nearly_none(rotation: np.ndarray, translation: np.ndarray) -> bool:
    """Whether a transform leaves points where they are, to 1 mm and 1 mrad."""
    return bool(np.abs(rotation - np.eye(3)).max() < 1e-3 and np.abs(translation).max() < 1e-3)


class UnplacedError(MessageError):
    """It is not known where the sensor of a message is; the text names both frames."""


class SensorPlace:
    """Where the sensor of a reference is: by reference_transform, else by tf."""

    def __init__(self, options: ReferenceOptions, transforms: TransformBuffer) -> None:
        """Raises ValueError as parse_transform."""
        self._kind = options.reference_type
        self._given = bool(options.reference_transform.strip())
        self._default = parse_transform(options.reference_transform, self._kind)
        self._transforms = transforms

    def of(self, message: Any, camera: str, stamp: int) -> Transform:
        """From the frame of a message to the camera's optical frame at a moment (nanoseconds).

        Without a frame_id on either side, or with the same one, the sensor is at the camera: see
        parse_transform.

        Raises:
            UnplacedError: tf does not know it, or a depth Image is of another place.
        """
        sensor, camera = frame_name(message.header.frame_id), frame_name(camera)
        if self._given or not sensor or not camera or sensor == camera:
            return self._default
        between = f"its frame_id is {sensor!r}, the images are of {camera!r}"
        try:
            found = self._transforms.lookup(camera, sensor, stamp)
        except TransformError as error:
            raise UnplacedError(
                f"{between}, and {error}; {_REMEDY[self._kind == IMAGE]}"
            ) from error
        if isinstance(found, NoPose):
            raise UnplacedError(f"{between}, and {found.detail}")
        pose = found.pose
        if self._kind == IMAGE and not _nearly_none(pose[:3, :3], pose[:3, 3]):
            raise UnplacedError(f"{between}, and tf has them apart; {_REMEDY[True]}")
        return Transform(pose[:3, :3], pose[:3, 3])


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """Unit quaternion x y z w -> 3 x 3."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def decode_points(message: Any) -> np.ndarray:
    """sensor_msgs/PointCloud2 -> N x 3 float64, the sensor's frame; non-finite values stay.

    x, y, z may be FLOAT32 or FLOAT64 at any offset, rows may be padded, either byte order. A
    distance or a coordinate of 65.535 or 65535 m is a sensor's word for no return: NaN.
    Raises MessageError when a coordinate is absent, or the data has not the bytes it should.
    """
    fields = {field.name: field for field in message.fields}
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise MessageError(f"the cloud has fields {sorted(fields)}, expected x, y and z")
    order = ">" if message.is_bigendian else "<"
    formats = []
    for axis in "xyz":
        number = _FORMATS.get(int(fields[axis].datatype))
        if number is None or int(fields[axis].count) > 1:
            raise MessageError(f"{axis} of the cloud is no FLOAT32 or FLOAT64")
        formats.append(order + number)
    step, width, height = int(message.point_step), int(message.width), int(message.height)
    try:
        layout = np.dtype(
            {
                "names": list("xyz"),
                "formats": formats,
                "offsets": [int(fields[axis].offset) for axis in "xyz"],
                "itemsize": step,
            }
        )
    except ValueError as error:
        raise MessageError(f"point_step {step} does not hold x, y and z: {error}") from error
    data = np.frombuffer(message.data, np.uint8) if len(message.data) else np.empty(0, np.uint8)
    row_step = int(message.row_step) or step * width
    if row_step < step * width or data.size < row_step * height:
        raise MessageError(
            f"cloud of {width} x {height} points, point_step {step}, row_step {row_step}, has "
            f"{data.size} bytes"
        )
    rows = data[: row_step * height].reshape(height, row_step)[:, : step * width]
    cloud = np.ascontiguousarray(rows).reshape(-1).view(layout)
    points = np.column_stack([cloud[axis].astype(np.float64) for axis in "xyz"])
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(points, axis=1)
    nothing = _no_return(distance) | _no_return(np.abs(points)).any(axis=1)
    return np.where(nothing[:, None], np.nan, points)


def _no_return(distance: np.ndarray) -> np.ndarray:
    """Where a driver has written its largest number, since nothing was seen."""
    found = np.zeros(distance.shape, bool)
    for number in _NO_RETURN:
        found |= np.abs(distance - number) < _EXACT
    return found


def decode_scan(message: Any) -> np.ndarray:
    """sensor_msgs/LaserScan -> N x 3 float64 metres (x forward, z = 0); out of range is NaN."""
    ranges = np.asarray(message.ranges, np.float64)
    angles = message.angle_min + message.angle_increment * np.arange(len(ranges))
    good = np.isfinite(ranges) & (ranges >= message.range_min) & (ranges <= message.range_max)
    good &= ~_no_return(ranges)
    ranges = np.where(good & (ranges > 0), ranges, np.nan)
    return np.column_stack([ranges * np.cos(angles), ranges * np.sin(angles), 0 * ranges])


def decode_range(message: Any) -> tuple[float, float, bool]:
    """sensor_msgs/Range -> distance (metres, NaN when out of range), half angle, is it sound.

    Raises MessageError for a field of view that is none.
    """
    view = float(message.field_of_view)
    if not (math.isfinite(view) and 0 <= view < math.pi):
        raise MessageError(f"field_of_view is {view}, expected radians in 0..pi")
    distance = float(message.range)
    good = math.isfinite(distance) and message.min_range <= distance <= message.max_range
    good = good and not _no_return(np.array(distance))
    return distance if good else math.nan, view / 2, int(message.radiation_type) == ULTRASOUND


def decode_reference(message: Any, kind: str, transform: Transform) -> Reference:
    """A measurement of a message of this type; raises MessageError."""
    if kind == IMAGE:
        depth = messages.decode_depth(message)
        return DepthReference(np.where(_no_return(depth), np.nan, depth))
    if kind == "Range":
        distance, half_angle, sound = decode_range(message)
        hit = transform(np.array([[distance, 0.0, 0.0]]))[0]
        return ConeReference(hit, half_angle, nearest=sound)
    points = decode_scan(message) if kind == "LaserScan" else decode_points(message)
    return PointReference(transform(points))


@dataclass(frozen=True)
class MessageReference:
    """A measurement that is decoded when a frame is compared with it.

    So a message that never meets a frame costs nothing. One that cannot be read counts as
    "not decodable", one of a sensor whose place is unknown as "sensor's place unknown", and `warn`
    takes the reason.
    """

    message: Any
    stamp: float
    kind: str
    place: SensorPlace
    warn: Callable[[str], None]

    def evidence(self, view: DepthView, stamp: float) -> Evidence:
        """See dyfn_core.metric.references.Reference."""
        try:
            transform = self.place.of(self.message, view.frame_id, round(self.stamp * 1e9))
            reference = decode_reference(self.message, self.kind, transform)
        except MessageError as error:
            self.warn(str(error))
            reason = NOT_PLACED if isinstance(error, UnplacedError) else "not decodable"
            return Evidence(stamp, np.empty(0), np.empty(0), Counter({reason: 1}))
        return reference.evidence(view, stamp)


def message_references(
    options: ReferenceOptions,
    warn: Callable[[str], None],
    transforms: TransformBuffer | None = None,
) -> Callable[[Any, float], MessageReference]:
    """The function that makes a measurement of a message and its stamp (seconds), for
    StreamSession.add_reference.

    Args:
        options: Type of the messages, and where the sensor is.
        warn: Takes the reason why a message cannot be used.
        transforms: Of /tf and /tf_static; None: nothing is known.

    Raises:
        ValueError: reference_type or reference_transform is not usable; the text names it.
    """
    place = SensorPlace(options, transforms or TransformBuffer())
    kind = options.reference_type
    return lambda message, stamp: MessageReference(message, stamp, kind, place, warn)
