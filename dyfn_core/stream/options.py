"""The node's parameters of the metric scale; a part of the table in parameter_table.py."""

from __future__ import annotations

from dataclasses import dataclass

from dyfn_ros.node.parameters.spec import RUN
from dyfn_ros.node.parameters.spec import parameter as _parameter

SCALE = "Metric scale"


@dataclass(frozen=True)
class MetricSettings:
    """Where metres come from and how a scale is kept: docs/metric_scale.md."""

    metric_source: str = _parameter(
        SCALE,
        "none",
        "Where metres come from. none: depth is relative. fixed: metric_scale. reference: "
        "measurements on `reference`. camera_height: over the ground.",
        per_camera=True,
        choices=("none", "fixed", "reference", "camera_height"),
    )
    metric_scale: float = _parameter(
        SCALE,
        1.0,
        "fixed: metres in one unit of the model's depth.",
        changes=RUN,
        per_camera=True,
        range=(1e-6, 1e6),
    )
    until_metric: str = _parameter(
        SCALE,
        "withhold",
        "Before a configured source has given a scale. withhold: everything is NaN. relative: "
        "depth up to scale, so that the topic's unit changes later.",
        changes=RUN,
        per_camera=True,
        choices=("withhold", "relative"),
    )
    reference_type: str = _parameter(
        SCALE,
        "PointCloud2",
        "Type of the topic `reference`. An Image is depth registered to the camera.",
        per_camera=True,
        choices=("Image", "PointCloud2", "LaserScan", "Range"),
    )
    reference_transform: str = _parameter(
        SCALE,
        "",
        "Pose of the sensor in the camera's optical frame, 'x y z qx qy qz qw'. Empty: at the "
        "camera, x forward for LaserScan and Range, optical axes for PointCloud2.",
        per_camera=True,
    )
    reference_tolerance: float = _parameter(
        SCALE,
        0.1,
        "Seconds between the stamps of a measurement and of the image it is compared with.",
        per_camera=True,
        range=(1e-3, 10.0),
    )
    camera_height: float = _parameter(
        SCALE,
        0.0,
        "camera_height: metres from the ground to the camera's centre.",
        per_camera=True,
        range=(0.0, 1000.0),
    )
    camera_pitch: float = _parameter(
        SCALE,
        0.0,
        "camera_height: degrees that the camera looks down.",
        per_camera=True,
        range=(-90.0, 90.0),
    )
    calibration: str = _parameter(
        SCALE,
        "hold",
        "hold: the first calibration stays until the stream starts anew. track: follow slowly.",
        per_camera=True,
        choices=("hold", "track"),
    )
    calibration_fit: str = _parameter(
        SCALE,
        "scale",
        "What is fitted: the shift along the depth is known already, except to some models.",
        per_camera=True,
        choices=("scale", "scale_shift"),
    )
    calibration_seconds: float = _parameter(
        SCALE,
        1.0,
        "Seconds of measurements that a fit is made on.",
        per_camera=True,
        range=(0.01, 600.0),
    )
    calibration_points: int = _parameter(
        SCALE,
        10,
        "Fewest points of a fit; a Range message or a frame's ground plane is one point.",
        per_camera=True,
        range=(2, 100_000),
    )
    tracking_rate: float = _parameter(
        SCALE,
        0.05,
        "track: fastest change of the scale, a share a second.",
        per_camera=True,
        range=(1e-4, 10.0),
    )
    reference_disagreement: float = _parameter(
        SCALE,
        0.25,
        "Measurements that differ by more from the scale in force (natural logarithm) for 3 s "
        "contradict it: a warning, and with track a new calibration.",
        per_camera=True,
        range=(0.01, 10.0),
    )
