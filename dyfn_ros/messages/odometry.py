"""Messages of odometry -> poses of a moving frame, and how fast their errors grow.

Reads any object with the fields of the ROS type, as images.py does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dyfn_core.geometry.rigid import quaternion_rotation, rigid
from dyfn_ros.messages.images import MessageError
from dyfn_ros.messages.odometry_options import POSE, POSE_COVARIANCE, TRANSFORM

NAMES_NO_CHILD = (POSE, POSE_COVARIANCE)  # types that do not say whose pose it is

_UNIT = 1e-2  # that a quaternion's length may differ from 1 by
_UNKNOWN = 1.0  # (m/s)^2 or (rad/s)^2, from which on a variance says "not measured"
_TRANSLATION, _ROTATION = slice(0, 3), slice(3, 6)


@dataclass(frozen=True)
class BodyPose:
    """What one message says.

    Attributes:
        stamp: Nanoseconds, of the header.
        frame: The fixed frame, without a slash in front.
        child: The moving frame; "" where the type has none.
        pose: 4 x 4 float64, child to frame, metres.
        pose_covariance: 6 diagonal values (x, y, z, and about them), m^2 and rad^2; None without.
        twist_covariance: The same of the velocities.
    """

    stamp: int
    frame: str
    child: str
    pose: np.ndarray
    pose_covariance: np.ndarray | None = None
    twist_covariance: np.ndarray | None = None


def frame_name(frame_id: str) -> str:
    """A frame's name; those of tf1 began with a slash."""
    return str(frame_id).lstrip("/")


def stamp_of(header: Any) -> int:
    """A header's stamp in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def pose_of(position: Any, orientation: Any) -> np.ndarray:
    """Point or Vector3, and Quaternion -> 4 x 4 float64.

    Raises MessageError for values that are not finite and a quaternion that is not of length 1.
    """
    place = np.array([position.x, position.y, position.z], np.float64)
    turn = np.array([orientation.w, orientation.x, orientation.y, orientation.z], np.float64)
    if not (np.isfinite(place).all() and np.isfinite(turn).all()):
        raise MessageError("the pose has values that are not finite")
    length = float(np.linalg.norm(turn))
    if abs(length - 1) > _UNIT:
        raise MessageError(f"the pose's quaternion has length {length:.3g}, expected 1")
    return rigid(quaternion_rotation(*turn), place)


def decode_body_pose(message: Any, kind: str) -> BodyPose:
    """A message of odometry -> what it says.

    Args:
        message: Of the type `kind`.
        kind: One of KINDS.

    Raises:
        MessageError: It holds no pose.
    """
    stamp, frame = stamp_of(message.header), frame_name(message.header.frame_id)
    if kind == TRANSFORM:
        pose = pose_of(message.transform.translation, message.transform.rotation)
        return BodyPose(stamp, frame, frame_name(message.child_frame_id), pose)
    if kind == POSE:
        return BodyPose(stamp, frame, "", pose_of(message.pose.position, message.pose.orientation))
    pose = pose_of(message.pose.pose.position, message.pose.pose.orientation)
    covariance = _diagonal(message.pose.covariance)
    if kind == POSE_COVARIANCE:
        return BodyPose(stamp, frame, "", pose, covariance)
    twist = _diagonal(message.twist.covariance)
    return BodyPose(stamp, frame, frame_name(message.child_frame_id), pose, covariance, twist)


def _diagonal(covariance: Sequence[float]) -> np.ndarray | None:
    """None for one that is not there: all 0, below 0 (by convention "unknown"), or not finite."""
    values = np.array(covariance, np.float64).reshape(-1)
    if len(values) != 36:
        return None
    diagonal = values[::7]
    if not np.isfinite(values).all() or (diagonal < 0).any() or not diagonal.any():
        return None
    return diagonal


class ErrorGrowth:
    """How much odometry's variance grows from message to message, by its own account.

    The pose's covariance is used where it grows: what it has gained. One that never changes says
    nothing about the motion between two poses, and drivers fill it with constants; the twist's is
    used then: each message's velocity is taken to err for itself, so the step of dt seconds has
    the variance of the velocity times dt^2. Axes that a driver declares unknown (a variance of 1
    or more in SI units, or 0) are left out; the mean of the others stands for all three.

    Attributes:
        source: "pose covariance", "twist covariance", or "none".
    """

    def __init__(self) -> None:
        self.source = "none"
        self._before: BodyPose | None = None
        self._grows = False

    def push(self, now: BodyPose) -> tuple[float, float] | None:
        """The next message.

        Returns:
            Variance of rotation (rad^2) and translation (m^2) per axis, from the message before to
            this one; 0 for the first one; None when unknown.
        """
        before, self._before = self._before, now
        if before is None or now.stamp <= before.stamp:
            return self._first(now)
        gained = _gained(before.pose_covariance, now.pose_covariance)
        if gained is not None and max(gained) > 0:
            self._grows = True
        if gained is not None and self._grows:
            self.source = "pose covariance"
            return gained
        seconds = (now.stamp - before.stamp) * 1e-9
        found = _of_velocity(now.twist_covariance, seconds)
        self.source = "none" if found is None else "twist covariance"
        return found

    def _first(self, now: BodyPose) -> tuple[float, float] | None:
        known = now.pose_covariance is not None or now.twist_covariance is not None
        return (0.0, 0.0) if known else None


def _gained(before: np.ndarray | None, now: np.ndarray | None) -> tuple[float, float] | None:
    if before is None or now is None:
        return None
    step = np.maximum(now - before, 0.0)  # less: a correction, of which nothing is known
    return float(step[_ROTATION].mean()), float(step[_TRANSLATION].mean())


def _of_velocity(variance: np.ndarray | None, seconds: float) -> tuple[float, float] | None:
    if variance is None:
        return None
    found = []
    for part in (variance[_ROTATION], variance[_TRANSLATION]):
        known = part[(part > 0) & (part < _UNKNOWN)]
        found.append(float(known.mean()) * seconds**2 if len(known) else math.nan)
    return None if any(map(math.isnan, found)) else (found[0], found[1])
