"""What one camera publishes; each message is built only when somebody subscribes."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, PointCloud2
from std_msgs.msg import Float32

from dyfn_core.evaluation.report.colours import colour_depth, depth_range
from dyfn_core.geometry.edges import flying_pixels
from dyfn_core.prediction import Prediction
from dyfn_ros.messages.camera_info import camera_info_message
from dyfn_ros.messages.clouds import (
    CLOUD_DTYPE,
    COMPACT_DTYPE,
    CloudMemory,
    cloud_message,
    pack_cloud,
)
from dyfn_ros.messages.compressed_depth import FARTHEST, encode_compressed_depth
from dyfn_ros.messages.images import (
    colour_message,
    compressed_message,
    depth_message,
    normal_message,
)
from dyfn_ros.node.output_size import smaller
from dyfn_ros.node.parameters.table import NodeSettings
from dyfn_ros.node.topics import NodeTopics

_OUTPUT_DEPTH = 5
_LOSSLESS_DEPTH = 100  # a cloud of 640 x 480 is 10 MB
_RESETS_DEPTH = 10


class NodeOutputs:
    """The topics `~/depth/...`, `~/points`, `~/normal` and `~/resets` of one camera.

    prefix: "" or "CAMERA/", before each of these names. inputs: topics of camera_info that the node
    subscribes. The inference thread publishes.
    """

    def __init__(
        self, ports: NodeTopics, prefix: str, lossless: bool, inputs: Collection[str] = ()
    ) -> None:
        depth = _LOSSLESS_DEPTH if lossless else _OUTPUT_DEPTH
        qos = QoSProfile(depth=depth, history=HistoryPolicy.KEEP_LAST)
        latched = QoSProfile(
            depth=_RESETS_DEPTH,
            history=HistoryPolicy.KEEP_LAST,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )

        def advertise(kind: type, topic: str) -> Any:
            return ports.publisher(kind, f"~/{prefix}{topic}", qos)

        names = ports.depth_names(f"~/{prefix}depth/image", f"~/{prefix}depth/camera_info", inputs)
        self._depth = advertise(Image, "depth/image")
        self._packed = ports.publisher(CompressedImage, names.compressed, qos)
        self._info = ports.publisher(CameraInfo, names.info, qos)
        self._valid_ratio = ports.publisher(Float32, f"~/{prefix}valid_ratio", QoSProfile(depth=10))
        self._colored = advertise(Image, "depth/colored")
        self._points = advertise(PointCloud2, "points")
        self._cloud_memory = CloudMemory()
        self._normal: Any = None
        self._advertise = advertise
        self._resets = ports.publisher(DiagnosticArray, f"~/{prefix}resets", latched)
        self._colours = ColourScale()

    def advertise_normals(self) -> None:
        """`~/normal`, for a model that has them."""
        self._normal = self._advertise(Image, "normal")

    def wants_normals(self, settings: NodeSettings) -> bool:
        """Whether the coming frame's normals are worth computing."""
        wanted = self._normal is not None and settings.publish_normal
        return wanted and bool(self._normal.get_subscription_count())

    def publish(
        self,
        header: Any,
        image: np.ndarray,
        prediction: Prediction[np.ndarray],
        info: CameraInfo | None,
        settings: NodeSettings,
    ) -> float:
        """header: of the input, kept as it is. info: describes the image; None when unknown.

        -> the share of pixels with depth.
        """
        if settings.output_scale != 1.0:
            prediction, image, info = smaller(prediction, image, info, settings.output_scale)
        depth, encoding = prediction.depth, settings.depth_encoding
        valid = in_range(depth, prediction.valid, settings.min_depth, settings.max_depth)
        share = np.count_nonzero(valid) / max(valid.size, 1)
        self._valid_ratio.publish(Float32(data=share))
        if settings.publish_depth:
            if self._depth.get_subscription_count():
                self._depth.publish(depth_message(header, depth, valid, encoding))
            if self._packed.get_subscription_count():
                farthest = settings.max_depth or FARTHEST
                packed = encode_compressed_depth(depth, valid, encoding, farthest)
                self._packed.publish(compressed_message(header, *packed))
            if self._info.get_subscription_count():
                self._info.publish(_sibling_info(header, info, prediction))
        if settings.publish_colored and self._colored.get_subscription_count():
            if prediction.reset:
                self._colours = ColourScale()
            painted = self._colours.paint(np.where(valid, depth, np.nan))
            self._colored.publish(colour_message(header, painted))
        if settings.publish_points and self._points.get_subscription_count():
            memory = self._cloud_memory
            cloud = filtered_cloud(prediction, valid, image, settings, memory)
            self._points.publish(cloud_message(header, cloud, memory))
        if prediction.normal is not None and self.wants_normals(settings):
            self._normal.publish(normal_message(header, prediction.normal, valid))
        return share

    def publish_reset(self, header: Any, name: str, reason: str, counts: dict[str, int]) -> None:
        """header: of the first frame after the reset. counts: resets so far, by reason."""
        values = [KeyValue(key=key, value=str(count)) for key, count in counts.items()]
        status = DiagnosticStatus(
            level=DiagnosticStatus.OK, name=name, message=reason, values=values
        )
        self._resets.publish(DiagnosticArray(header=header, status=[status]))


class ColourScale:
    """Depth as colours whose scale follows the scene slowly, so that pictures do not flicker."""

    def __init__(self, weight: float = 0.1) -> None:
        """weight: of a new frame's range; the first frame's counts whole."""
        self._weight = weight
        self._range: np.ndarray | None = None

    def paint(self, depth: np.ndarray) -> np.ndarray:
        """H x W depth, NaN invalid -> H x W x 3 uint8 RGB, see colour_depth."""
        sample = depth[::4, ::4]
        if np.isfinite(sample).any():
            now = np.log(depth_range([sample]))
            before = now if self._range is None else self._range
            self._range = before + self._weight * (now - before)
        near, far = (1.0, 2.0) if self._range is None else np.exp(self._range)
        return colour_depth(depth, float(near), float(far))


def filtered_cloud(
    prediction: Prediction[np.ndarray],
    valid: np.ndarray,
    image: np.ndarray,
    settings: NodeSettings,
    memory: CloudMemory,
) -> np.ndarray:
    """The cloud that the points_... settings ask for: h x w of CLOUD_DTYPE or COMPACT_DTYPE.

    Range and edges are judged at full resolution; the stride then takes the middle pixel of each
    block.
    """
    valid = in_range(prediction.depth, valid, settings.points_min_depth, settings.points_max_depth)
    if settings.points_edge_filter:
        valid &= ~flying_pixels(prediction.depth, valid, settings.points_edge_filter)
    stride = settings.points_stride
    first = (min(stride, *valid.shape) - 1) // 2
    grid = (slice(first, None, stride),) * 2
    dtype = COMPACT_DTYPE if settings.points_compact else CLOUD_DTYPE
    return pack_cloud(prediction.points[grid], valid[grid], image[grid], dtype, memory)


def in_range(depth: np.ndarray, valid: np.ndarray, near: float, far: float) -> np.ndarray:
    """H x W bool: valid and near <= depth <= far; far 0 is no limit."""
    valid = valid & (depth >= near)
    return valid & (depth <= far) if far else valid


def _sibling_info(
    header: Any, info: CameraInfo | None, prediction: Prediction[np.ndarray]
) -> CameraInfo:
    """The camera_info beside the depth image: the camera's own, or what is known."""
    if info is None:
        height, width = prediction.depth.shape
        return camera_info_message(header, prediction.camera_matrix, height, width)
    sibling = copy.copy(info)
    sibling.header = header
    return sibling
