"""Recordings with poses and true depth, through the network with and without DyFN.

For benchmarks of metric_source odometry; see scale_from_motion.py.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from dyfn_core import DepthStream, load_model
from dyfn_core.data.rendered import read_shard
from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.metric.motion_scale import MotionFrame
from dyfn_core.scoring.protocols import to_shape
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.poses import open_poses
from dyfn_ros.recordings.rgbd_folder import is_rgbd_folder

TRUE_TOPIC, ODOMETRY_TOPIC = "/ground_truth/pose", "/odom"  # of a bag, as bags/demo has them
RATE = 10.0  # frames a second of a rendered clip, whose files do not say


@dataclass(frozen=True)
class Posed:
    """One frame of a recording: stamp in seconds, truth in metres, poses camera to world."""

    image: np.ndarray
    stamp: float
    camera: np.ndarray
    truth: np.ndarray
    pose: np.ndarray | None
    odometry: np.ndarray | None = None


@dataclass(frozen=True)
class Predicted:
    """One frame: `base` and `frame.depth` (DyFN) are predictions, `truth` is in metres.

    frame.pose is the true one; odometry: the recorded robot's own, where there is one.
    """

    frame: MotionFrame
    base: np.ndarray
    truth: np.ndarray
    odometry: np.ndarray | None


def posed_frames(source: Path) -> Iterator[Posed]:
    """The frames of an RGB-D folder with poses, a bag with the topics above, or a rendered clip."""
    if (source / "meta.json").is_file():
        yield from _clip(source)
        return
    folder = source.is_dir() and is_rgbd_folder(source)
    true = odometry = None
    for frame in open_recording(source).frames():
        if true is None:
            true = open_poses(source, frame.frame_id, None if folder else TRUE_TOPIC)
            if not folder:
                odometry = open_poses(source, frame.frame_id, ODOMETRY_TOPIC)
        if frame.depth is None or frame.camera_matrix is None:
            continue
        place = frame.index, frame.stamp_ns
        own = None if odometry is None else odometry(*place)
        depth = to_shape(frame.depth, frame.image.shape[:2])
        stamp = frame.stamp_ns / 1e9
        yield Posed(frame.image, stamp, frame.camera_matrix, depth, true(*place), own)


def _clip(folder: Path) -> Iterator[Posed]:
    shard = read_shard(folder)
    for index in range(len(shard)):
        frame = shard.read(index)
        fx, fy, cx, cy = frame.intrinsics.astype(np.float64)
        camera = pixel_intrinsics(
            np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), frame.depth.shape
        )
        yield Posed(frame.image, index / RATE, camera, frame.depth, frame.pose)


def predicted(
    source: Path, model_name: str, every: int = 1, count: int | None = None
) -> Iterator[Predicted]:
    """Every Nth frame that has a pose and depth, at most `count`, through the network twice."""
    model = load_model(model_name)
    streams: list[DepthStream] = []
    chosen = (frame for i, frame in enumerate(posed_frames(source)) if i % every == 0)
    for one in islice(chosen, count):
        if one.pose is None:
            continue
        if not streams:
            streams = [
                DepthStream(model, camera_matrix=one.camera, stabilize=on) for on in (True, False)
            ]
        image = np.ascontiguousarray(one.image)
        found = (stream.push(image) for stream in streams)
        dyfn, base = (np.where(p.mask, p.depth, np.nan).astype(np.float32) for p in found)
        frame = MotionFrame(image, one.stamp, one.camera, one.pose, dyfn, np.isfinite(dyfn))
        yield Predicted(frame, base, one.truth, one.odometry)
