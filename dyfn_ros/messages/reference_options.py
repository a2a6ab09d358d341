"""The options that say how messages of metric_source "reference" are read; no torch in here."""

from __future__ import annotations

from dataclasses import dataclass

from dyfn_core.stream.options import SCALE, option

REFERENCE_TYPES = ("Image", "PointCloud2", "LaserScan", "Range")


@dataclass(frozen=True)
class ReferenceOptions:
    """What the topic of metric_source "reference" holds; for the node and dyfn-replay."""

    reference_type: str = option(
        SCALE,
        "PointCloud2",
        "Type of the topic `reference`. An Image is depth registered to the camera.",
        choices=REFERENCE_TYPES,
    )
    reference_transform: str = option(
        SCALE,
        "",
        "Pose of the sensor in the camera's optical frame, 'x y z qx qy qz qw'. Empty: by tf from "
        "the frame_id of the messages. Where that is empty or the images' own: at the camera, x "
        "forward for LaserScan and Range, optical axes for PointCloud2.",
    )
