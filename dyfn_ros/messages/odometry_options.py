"""The options that say how metric_source "odometry" gets its poses; no torch in here."""

from __future__ import annotations

from dataclasses import dataclass

from dyfn_core.metric.pose_limits import PoseLimits
from dyfn_core.stream.options import SCALE, option

ODOMETRY, POSE = "Odometry", "PoseStamped"
POSE_COVARIANCE, TRANSFORM = "PoseWithCovarianceStamped", "TransformStamped"
KINDS = (ODOMETRY, POSE, POSE_COVARIANCE, TRANSFORM)
TF = "TF"


@dataclass(frozen=True)
class OdometryOptions:
    """Where the poses of metric_source "odometry" come from; for the node and dyfn-replay."""

    odometry_type: str = option(
        SCALE,
        ODOMETRY,
        "odometry: type of the topic `odometry`. TF: the camera in odom_frame, by /tf and "
        "/tf_static, without a topic.",
        choices=(*KINDS, TF),
    )
    odom_frame: str = option(
        SCALE,
        "odom",
        "odometry_type TF: the frame that the robot moves in without jumps.",
    )
    moving_frame: str = option(
        SCALE,
        "",
        "odometry: the frame whose pose the odometry is. Empty: the message's child_frame_id; the "
        "camera's own for types without one, and for TF.",
    )
    camera_pose: str = option(
        SCALE,
        "",
        "odometry: pose of the camera's optical frame in the moving frame, 'x y z qx qy qz qw'. "
        "Empty: by /tf and /tf_static; nothing where both are one frame.",
    )
    odometry_tolerance: float = option(
        SCALE,
        PoseLimits.tolerance,
        "odometry: seconds beyond the newest pose in which the motion is taken to go on.",
        range=(0.0, 1.0),
    )
    odometry_wait: float = option(
        SCALE,
        0.2,
        "odometry: seconds after an image's arrival that its depth waits for the pose, at most.",
        range=(0.0, 10.0),
    )
    odometry_max_speed: float = option(
        SCALE,
        PoseLimits.speed,
        "odometry: metres a second; a faster step between two poses is a jump.",
        range=(0.01, 1e4),
    )
    odometry_max_turn: float = option(
        SCALE,
        PoseLimits.turn,
        "odometry: radians a second; a faster turn between two poses is a jump.",
        range=(0.01, 1e4),
    )

    @property
    def pose_limits(self) -> PoseLimits:
        """What poses are believed."""
        return PoseLimits(
            tolerance=self.odometry_tolerance,
            speed=self.odometry_max_speed,
            turn=self.odometry_max_turn,
        )
