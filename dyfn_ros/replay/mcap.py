"""output.mcap, a recording for Foxglove that can be scored again: input, truth, depth, poses."""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.evaluation.report.colours import colour_depth, depth_range
from dyfn_core.prediction import Prediction
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_core.scoring.protocols import sample_grid
from dyfn_ros.messages.clouds import CLOUD_OFFSETS, CLOUD_STEP, pack_cloud
from dyfn_ros.messages.compressed_depth import encode_depth_range
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
    compressed_message,
    header,
)
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cloud import camera_points
from dyfn_ros.replay.foxglove import write_layout
from dyfn_ros.replay.frame_spool import FrameSpool, SmallFrame
from dyfn_ros.replay.shown_run import ShownRun

MAX_POINTS = 20_000  # of a frame's cloud as it was predicted
FEW_POINTS = 5_000  # of one for the world
WORLD = "world"
DEPTH = "/stream_depth/depth/image"
POINTS = "/stream_depth/points"
COLOURED = "/stream_depth/depth/colored/compressed"
COLOURED_TRUTH = "/stream_depth/depth/colored_ground_truth/compressed"
SHOWN_QUALITY = 75  # of JPEGs that are looked at only
RANGE_FRAMES = 32
COARSE = 5e-3  # relative error of compressed depth that is warned about
_FLOAT32 = 7  # sensor_msgs/PointField


class ReplayRecording:
    """Writes the frames of a replay with the input's stamps and times of recording.

    Topics: the input's image (as recorded; JPEG when it was raw or had a lens, which is undone)
    and CameraInfo; /tf and /stream_depth/pose where poses are known; NAMESPACE/ground_truth/image
    beside the image; the node's. raw: depth is 32FC1 and clouds are organised, as predicted, at
    most MAX_POINTS; else depth is compressedDepth of the image's own range, and `finish` adds
    clouds of at most FEW_POINTS and coloured depth, aligned for the whole recording. notes: what to
    warn about.
    """

    def __init__(self, path: Path, *, raw: bool = False) -> None:
        self._writer = RecordingWriter(path, overwrite=True)
        self._raw = raw
        self._times = array("q")
        self._frame_ids: list[str] = []
        self._image_topic = ""
        self._coarse: list[float] = []  # errors beyond it
        self._ends = (np.inf, 0.0)  # of the depth as it was predicted

    def __enter__(self) -> ReplayRecording:
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    @property
    def notes(self) -> list[str]:
        """What to warn about."""
        if not self._coarse:
            return []
        return [
            f"output.mcap: in {len(self._coarse)} frames the farthest depth is off by more than "
            f"{COARSE:.1%}, at most by {max(self._coarse):.2%}; --write raw keeps it as it is"
        ]

    def write(
        self,
        frame: RecordedFrame,
        prediction: Prediction[np.ndarray],
        score: FrameScore,
        pose: np.ndarray | None,
    ) -> None:
        """Everything of one frame. pose: 4 x 4, camera to world; None: unknown."""
        time = frame.source.log_ns
        self._times.append(time)
        self._frame_ids.append(frame.frame_id)
        self._write_input(frame, time)
        if pose is not None:
            self._writer.write_transform(pose, frame.stamp_ns, WORLD, frame.frame_id, log_ns=time)
            self._writer.write_pose("/stream_depth/pose", pose, frame.stamp_ns, WORLD, log_ns=time)
        self._write_depth(DEPTH, prediction.depth, prediction.valid, frame, time)
        if frame.depth is not None:
            truth = f"{_namespace(self._image_topic)}/ground_truth/image"
            self._write_depth(truth, frame.depth, np.isfinite(frame.depth), frame, time)
        topic, size = "/stream_depth/depth/camera_info", prediction.depth.shape
        info = camera_info(prediction.camera_matrix, size, frame.stamp_ns, frame.frame_id)
        self._writer.write(topic, CAMERA_INFO, info, time)
        if self._raw:
            near, far = depth_range([prediction.depth[prediction.valid]])
            self._ends = min(near, self._ends[0]), max(far, self._ends[1])
            self._writer.write(POINTS, POINT_CLOUD, cloud_message(frame, prediction), time)
        for name, value in score_values(prediction, score).items():
            number = TYPES.types[FLOAT](data=value)
            self._writer.write(f"/stream_depth/{name}", FLOAT, number, time)

    def _write_depth(
        self, topic: str, depth: np.ndarray, valid: np.ndarray, frame: RecordedFrame, time: int
    ) -> None:
        if self._raw:
            head = header(frame.stamp_ns, frame.frame_id)
            image = TYPES.types[IMAGE](header=head, **depth_fields(depth, valid))
            self._writer.write(topic, IMAGE, image, time)
            return
        layout, data, error = encode_depth_range(depth, valid)
        if error > COARSE:
            self._coarse.append(error)
        pixels = np.frombuffer(data, np.uint8)
        message = compressed_message(pixels, layout, frame.stamp_ns, frame.frame_id)
        self._writer.write(f"{topic}/compressedDepth", COMPRESSED_IMAGE, message, time)

    def _write_input(self, frame: RecordedFrame, time: int) -> None:
        """An image whose lens was undone is written so, with the CameraInfo of a pinhole: depth is
        of that image, and a reader must not undo the lens a second time."""
        source, info = frame.source, frame.info
        undone = frame.lens_undone
        if info is not None and frame.camera_matrix is not None and undone:
            size = (frame.image.shape[0], frame.image.shape[1])
            pinhole = camera_info(frame.camera_matrix, size, frame.stamp_ns, frame.frame_id)
            self._writer.write(info.topic, CAMERA_INFO, pinhole, time)
        elif info is not None:
            self._writer.write_cdr(info.topic, info.kind, info.data, time)
        if source.kind == COMPRESSED_IMAGE and not undone:
            self._image_topic = source.topic
            self._writer.write_cdr(source.topic, source.kind, source.data, time)
            return
        compressed = source.topic.endswith("/compressed")
        self._image_topic = source.topic if compressed else f"{source.topic}/compressed"
        self._writer.write_jpeg(
            self._image_topic, frame.image, frame.stamp_ns, frame.frame_id, log_ns=time
        )

    def finish(self, spool: FrameSpool | None, run: ShownRun) -> None:
        """Add what needs the alignment of the whole recording.

        Args:
            spool: The same frames; None with raw.
            run: Their alignment.
        """
        if spool is None or not spool.frames:
            return
        every = max(1, spool.frames // RANGE_FRAMES)
        some = [frame for place, frame in enumerate(spool) if place % every == 0]
        truths = [frame.truth for frame in some if frame.truth is not None]
        self._ends = depth_range(truths or [run.alignment.depth(f.predicted) for f in some])
        for frame, time, frame_id in zip(spool, self._times, self._frame_ids, strict=True):
            self._write_aligned(frame, run, time, frame_id)

    def write_layout(self, path: Path) -> None:
        """Write a layout for Foxglove, whose colours have the recording's range of depth."""
        write_layout(path, self._image_topic, raw=self._raw, depth=self._ends)

    def _write_aligned(
        self,
        frame: SmallFrame,
        run: ShownRun,
        time: int,
        frame_id: str,
    ) -> None:
        depth = run.alignment.depth(frame.predicted)
        grid = np.zeros(depth.shape, bool)
        grid[sample_grid(depth.shape, FEW_POINTS)] = True
        points, colours = camera_points(frame, depth, frame.solid & grid, np.inf)
        cloud = pack_cloud(points[None], np.ones((1, len(points)), bool), colours[None])
        head = header(frame.stamp_ns, frame_id)
        self._writer.write(POINTS, POINT_CLOUD, _compact(cloud, head), time)
        pictures = {COLOURED: depth, COLOURED_TRUTH: frame.truth}
        for topic, values in pictures.items():
            if values is not None:
                painted = colour_depth(values, *self._ends)
                self._writer.write_jpeg(
                    topic, painted, frame.stamp_ns, frame_id, quality=SHOWN_QUALITY, log_ns=time
                )


def _namespace(image_topic: str) -> str:
    return image_topic.removesuffix("/compressed").rsplit("/", 1)[0]


def _compact(cloud: np.ndarray, head: Any) -> Any:
    """An unorganised PointCloud2 without padding: x y z rgb."""
    packed = np.stack([cloud[name][0] for name in CLOUD_OFFSETS], axis=1)
    offsets = {name: 4 * place for place, name in enumerate(CLOUD_OFFSETS)}
    return _cloud(head, (1, len(packed)), offsets, 16, packed, dense=True)


def cloud_message(frame: RecordedFrame, prediction: Prediction[np.ndarray]) -> Any:
    """A PointCloud2 of every s-th point, s the smallest that gives at most MAX_POINTS."""
    cloud = pack_cloud(*subsampled(frame.image, prediction))
    head = header(frame.stamp_ns, frame.frame_id)
    return _cloud(head, cloud.shape, CLOUD_OFFSETS, CLOUD_STEP, cloud, dense=False)


def _cloud(
    head: Any,
    shape: tuple[int, ...],
    offsets: dict[str, int],
    step: int,
    data: np.ndarray,
    dense: bool,
) -> Any:
    field = TYPES.types["sensor_msgs/msg/PointField"]
    return TYPES.types[POINT_CLOUD](
        header=head,
        height=shape[0],
        width=shape[1],
        fields=[
            field(name=name, offset=offset, datatype=_FLOAT32, count=1)
            for name, offset in offsets.items()
        ],
        is_bigendian=False,
        point_step=step,
        row_step=step * shape[1],
        data=np.ascontiguousarray(data).reshape(-1).view(np.uint8),
        is_dense=dense,
    )


def subsampled(
    image: np.ndarray, prediction: Prediction[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, validity and colours of every s-th row and column, at most MAX_POINTS."""
    grid = sample_grid(prediction.depth.shape, MAX_POINTS)
    return prediction.points[grid], prediction.valid[grid], image[grid]


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
