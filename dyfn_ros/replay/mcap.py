"""output.mcap, a recording for Foxglove: input, depth, camera info, cloud, scale."""

from __future__ import annotations

from typing import Any

import numpy as np

from dyfn_core.prediction import Prediction
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_core.scoring.protocols import sample_grid
from dyfn_ros.messages.clouds import CLOUD_OFFSETS, CLOUD_STEP, pack_cloud
from dyfn_ros.messages.images import depth_fields
from dyfn_ros.recordings.open import RecordedFrame
from dyfn_ros.recordings.typestore import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FLOAT,
    IMAGE,
    POINT_CLOUD,
    TYPES,
    camera_info,
    header,
)
from dyfn_ros.recordings.writer import RecordingWriter

MAX_POINTS = 20_000
_FLOAT32 = 7  # sensor_msgs/PointField


class ReplayRecording:
    """Writes the frames of a replay on the node's topics, with the input's stamps.

    Topics: the input image as JPEG (or as recorded when it was compressed),
    /stream_depth/depth/image (32FC1), /stream_depth/depth/camera_info and
    /stream_depth/points (organised, every s-th row and column, at most MAX_POINTS).
    """

    def __init__(self, path: Any) -> None:
        self._writer = RecordingWriter(path, overwrite=True)

    def __enter__(self) -> ReplayRecording:
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def write(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], score: FrameScore
    ) -> None:
        """Everything of one frame."""
        self._write_input(frame)
        head = header(frame.stamp_ns, frame.frame_id)
        image = TYPES.types[IMAGE](header=head, **depth_fields(prediction.depth, prediction.valid))
        self._writer.write("/stream_depth/depth/image", IMAGE, image, frame.stamp_ns)
        topic, size = "/stream_depth/depth/camera_info", prediction.depth.shape
        info = camera_info(prediction.camera_matrix, size, frame.stamp_ns, frame.frame_id)
        self._writer.write(topic, CAMERA_INFO, info, frame.stamp_ns)
        cloud = cloud_message(frame, prediction)
        self._writer.write("/stream_depth/points", POINT_CLOUD, cloud, frame.stamp_ns)
        for name, value in score_values(prediction, score).items():
            number = TYPES.types[FLOAT](data=value)
            self._writer.write(f"/stream_depth/{name}", FLOAT, number, frame.stamp_ns)

    def _write_input(self, frame: RecordedFrame) -> None:
        source, info = frame.source, frame.info
        if info is not None:
            self._writer.write_cdr(info.topic, info.kind, info.data, frame.stamp_ns)
        if source.kind == COMPRESSED_IMAGE:
            self._writer.write_cdr(source.topic, source.kind, source.data, frame.stamp_ns)
            return
        topic = f"{source.topic}/compressed"
        self._writer.write_jpeg(topic, frame.image, frame.stamp_ns, frame.frame_id)


def cloud_message(frame: RecordedFrame, prediction: Prediction[np.ndarray]) -> Any:
    """A PointCloud2 of every s-th point, s the smallest that gives at most MAX_POINTS."""
    cloud = pack_cloud(*subsampled(frame, prediction))
    field = TYPES.types["sensor_msgs/msg/PointField"]
    return TYPES.types[POINT_CLOUD](
        header=header(frame.stamp_ns, frame.frame_id),
        height=cloud.shape[0],
        width=cloud.shape[1],
        fields=[
            field(name=name, offset=offset, datatype=_FLOAT32, count=1)
            for name, offset in CLOUD_OFFSETS.items()
        ],
        is_bigendian=False,
        point_step=CLOUD_STEP,
        row_step=CLOUD_STEP * cloud.shape[1],
        data=np.ascontiguousarray(cloud).reshape(-1).view(np.uint8),
        is_dense=False,
    )


def subsampled(
    frame: RecordedFrame, prediction: Prediction[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, validity and colours of every s-th row and column, at most MAX_POINTS."""
    grid = sample_grid(prediction.depth.shape, MAX_POINTS)
    return prediction.points[grid], prediction.valid[grid], frame.image[grid]


def score_values(prediction: Prediction[np.ndarray], score: FrameScore) -> dict[str, float]:
    """Numbers to plot over time: the frame's median depth, and with truth its own alignment.

    median_depth: in the unit of the depth. scale, shift: what aligns this frame alone to the
    truth (image protocol; shift in metres). abs_rel: after that.
    """
    values: dict[str, float] = {}
    if prediction.valid.any():
        values["median_depth"] = float(np.median(prediction.depth[prediction.valid]))
    if score.metrics is not None and score.scale is not None and score.shift is not None:
        values |= {"scale": score.scale, "shift": score.shift, "abs_rel": score.metrics["abs_rel"]}
    return values
