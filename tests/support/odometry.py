"""A robot on a circle with a camera on it: its true poses, and the messages of its odometry."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from nav_msgs.msg import Odometry

from dyfn_core.geometry.rigid import quaternion_rotation, rigid
from dyfn_ros.recordings.typestore import quaternion_from_matrix

SECOND = 1_000_000_000
CAMERA = "camera_optical"
TIMES = np.arange(0, 2, 0.05)  # seconds of a drive
# Optical axes (right, down, forward) of a camera that looks ahead, 0.3 m before the base's centre,
# 0.5 m above it, turned 30 degrees to the left and tilted down by 10.
_LEFT = quaternion_rotation(np.cos(np.radians(15)), 0, 0, np.sin(np.radians(15)))
_DOWN = quaternion_rotation(np.cos(np.radians(5)), 0, np.sin(np.radians(5)), 0)
MOUNT = rigid(
    _LEFT @ _DOWN @ np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.array([0.3, 0.0, 0.5])
)


def base_pose(seconds: float, radius: float = 2.0, rate: float = 0.25) -> np.ndarray:
    """Of a base (x forward, z up) that drives on a circle to its left."""
    angle = rate * seconds
    turn = quaternion_rotation(np.cos(angle / 2), 0, 0, np.sin(angle / 2))
    return rigid(turn, radius * np.array([np.sin(angle), 1 - np.cos(angle), 0]))


def camera_pose(seconds: float) -> np.ndarray:
    return base_pose(seconds) @ MOUNT


def pose_text(pose: np.ndarray) -> str:
    """As parameters have it."""
    return " ".join(f"{v:.12g}" for v in (*pose[:3, 3], *quaternion_from_matrix(pose[:3, :3])))


def _quaternion(pose: np.ndarray) -> Quaternion:
    x, y, z, w = quaternion_from_matrix(pose[:3, :3])
    return Quaternion(x=x, y=y, z=z, w=w)


def _stamped(message: Any, seconds: float, frame: str) -> Any:
    sec, nanosec = divmod(round(seconds * SECOND), SECOND)
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    return message


def _pose(pose: np.ndarray) -> Pose:
    x, y, z = (float(v) for v in pose[:3, 3])
    return Pose(position=Point(x=x, y=y, z=z), orientation=_quaternion(pose))


def odometry(
    pose: np.ndarray,
    seconds: float,
    frame: str = "odom",
    child: str = "base_link",
    covariance: np.ndarray | None = None,
    twist: np.ndarray | None = None,
) -> Odometry:
    """covariance, twist: 6 diagonal values."""
    message = _stamped(Odometry(child_frame_id=child), seconds, frame)
    message.pose.pose = _pose(pose)
    if covariance is not None:
        message.pose.covariance = np.diag(np.asarray(covariance, np.float64)).reshape(-1)
    if twist is not None:
        message.twist.covariance = np.diag(np.asarray(twist, np.float64)).reshape(-1)
    return message


def pose_stamped(pose: np.ndarray, seconds: float, frame: str = "odom") -> PoseStamped:
    message = _stamped(PoseStamped(), seconds, frame)
    message.pose = _pose(pose)
    return message


def pose_with_covariance(
    pose: np.ndarray, seconds: float, covariance: np.ndarray, frame: str = "odom"
) -> PoseWithCovarianceStamped:
    message = _stamped(PoseWithCovarianceStamped(), seconds, frame)
    message.pose.pose = _pose(pose)
    message.pose.covariance = np.diag(np.asarray(covariance, np.float64)).reshape(-1)
    return message


def transform(pose: np.ndarray, seconds: float, parent: str, child: str) -> TransformStamped:
    """pose: 4 x 4, child to parent."""
    message = _stamped(TransformStamped(child_frame_id=child), seconds, parent)
    x, y, z = (float(v) for v in pose[:3, 3])
    message.transform = Transform(translation=Vector3(x=x, y=y, z=z), rotation=_quaternion(pose))
    return message


def use_tf_stand_in() -> None:
    """Where tf2_msgs is not installed (no wheels have it), /tf carries one TransformStamped each.

    For the node's process; `tf_topic` sends accordingly.
    """
    if find_spec("tf2_msgs") is not None:
        return
    TransformStamped.transforms = property(lambda self: [self])
    package, messages = ModuleType("tf2_msgs"), ModuleType("tf2_msgs.msg")
    package.msg, messages.TFMessage = messages, TransformStamped  # type: ignore[attr-defined]
    sys.modules.update({"tf2_msgs": package, "tf2_msgs.msg": messages})


def tf_topic(transform: TransformStamped) -> Any:
    """What a publisher of /tf sends to such a node."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return transform
    return transform if TFMessage is TransformStamped else TFMessage(transforms=[transform])


def tf_message(*transforms: TransformStamped) -> Any:
    """Like a tf2_msgs/TFMessage, which no wheels have."""
    return SimpleNamespace(transforms=list(transforms))
