"""What one camera publishes; each message is built only when somebody subscribes."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from dyfn_ros import messages
from dyfn_ros.camera_stream import Geometry
from dyfn_ros.parameter_table import Settings
from dyfn_ros.ports import Ports

_OUTPUT_DEPTH = 5
_LOSSLESS_DEPTH = 100  # a cloud of 640 x 480 is 10 MB
_RESETS_DEPTH = 10


class Outputs:
    """The topics `~/depth/...`, `~/points` and `~/resets` of one camera.

    prefix: "" or "CAMERA/", before each of these names.
    """

    def __init__(self, ports: Ports, prefix: str, lossless: bool) -> None:
        depth = _LOSSLESS_DEPTH if lossless else _OUTPUT_DEPTH
        qos = QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST)
        latched = QoSProfile(
            depth=_RESETS_DEPTH,
            history=HistoryPolicy.KEEP_LAST,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._depth = ports.publisher(Image, f"~/{prefix}depth/image", qos)
        self._info = ports.publisher(CameraInfo, f"~/{prefix}depth/camera_info", qos)
        self._points = ports.publisher(PointCloud2, f"~/{prefix}points", qos)
        self._resets = ports.publisher(DiagnosticArray, f"~/{prefix}resets", latched)

    def publish(
        self,
        header: Any,
        image: np.ndarray,
        geometry: Geometry,
        info: CameraInfo | None,
        settings: Settings,
    ) -> None:
        """header: of the input, kept as it is. info: describes the image; None when unknown."""
        valid = in_range(geometry.depth, geometry.valid, settings.min_depth, settings.max_depth)
        if settings.publish_depth:
            if self._depth.get_subscription_count():
                self._depth.publish(messages.depth_message(header, geometry.depth, valid))
            if self._info.get_subscription_count():
                self._info.publish(_sibling_info(header, info, geometry))
        if settings.publish_points and self._points.get_subscription_count():
            cloud = messages.pack_cloud(geometry.points, valid, image)
            self._points.publish(messages.cloud_message(header, cloud))

    def publish_reset(self, header: Any, name: str, reason: str, counts: dict[str, int]) -> None:
        """header: of the first frame after the reset. counts: resets so far, by reason."""
        values = [KeyValue(key=key, value=str(count)) for key, count in counts.items()]
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK, name=name, message=reason, values=values
        )
        self._resets.publish(DiagnosticArray(header=header, status=[status]))


def in_range(depth: np.ndarray, valid: np.ndarray, near: float, far: float) -> np.ndarray:
    """H x W bool: valid and near <= depth <= far; far 0 is no limit."""
    valid = valid & (depth >= near)
    return valid & (depth <= far) if far else valid


def _sibling_info(header: Any, info: CameraInfo | None, geometry: Geometry) -> CameraInfo:
    """The camera_info beside the depth image: the camera's own, or what is known."""
    if info is None:
        height, width = geometry.depth.shape
        return messages.camera_info_message(header, geometry.camera_matrix, height, width)
    sibling = copy.copy(info)
    sibling.header = header
    return sibling
