"""Metres for a model's depth from what a benchmark gives beside the images, as the stream does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dyfn_core.data.frames import DataError
from dyfn_core.evaluation.benchmarks.sets.base import BenchmarkFrame
from dyfn_core.evaluation.choices import POINTS, POSES
from dyfn_core.metric.motion import MotionPoints
from dyfn_core.metric.motion_scale import MotionFrame, MotionScaleOptions, MotionScaleState, step

RATE = 10.0  # frames a second of benchmarks without stamps
SIGMA = 0.1  # of the log depth of points that come with the frames, whose errors are not told


class MetresStream:
    """One sequence: scale and scale field of every frame from sparse points or from poses.

    "points" are those that come with the frames; with "poses" they are tracked and triangulated
    here. Scale, filter and field are those of metric_source "odometry".
    """

    def __init__(self, source: str, sequence: str) -> None:
        """Begin.

        Args:
            source: One of METRES.
            sequence: Its name, for messages.
        """
        self._source, self._sequence = source, sequence
        # Nothing can contradict points that are given; odometry has to agree with pictures first.
        start = MotionScaleState()
        self._state = replace(start, contradicted=0.0) if source == POINTS else start
        self._options = MotionScaleOptions()

    def push(self, index: int, frame: BenchmarkFrame, depth: np.ndarray) -> np.ndarray:
        """The next frame.

        Args:
            index: Its place in the sequence.
            frame: What the benchmark gives.
            depth: H x W float32, predicted, NaN where there is no prediction.

        Returns:
            H x W float32 metres, NaN where there is no prediction, and all over while no metres
            are known.

        Raises:
            DataError: The benchmark has no intrinsics, or no points where they are wanted.
        """
        if frame.camera_matrix is None:
            raise DataError(f"{self._sequence}: metres need intrinsics, which it does not have")
        made = MotionFrame(
            image=np.ascontiguousarray(frame.image),
            stamp=index / RATE if frame.stamp is None else frame.stamp,
            camera_matrix=frame.camera_matrix,
            pose=frame.pose if self._source == POSES else None,
            depth=depth,
            valid=np.isfinite(depth),
            points=self._points(frame) if self._source == POINTS else None,
        )
        self._state, scale = step(self._state, made, self._options)
        metres = scale.metres(depth)
        return np.full(depth.shape, np.nan, np.float32) if metres is None else metres

    def _points(self, frame: BenchmarkFrame) -> MotionPoints:
        if frame.sparse is None:
            raise DataError(f"{self._sequence}: the benchmark gives no sparse points")
        rows, columns = np.nonzero(np.isfinite(frame.sparse) & (frame.sparse > 0))
        ratio = np.array(frame.image.shape[1::-1]) / np.array(frame.sparse.shape[::-1])
        sigma = np.full(len(rows), SIGMA)
        return MotionPoints(
            ids=np.arange(len(rows), dtype=np.int64),
            pixels=(np.column_stack([columns, rows]) + 0.5) * ratio - 0.5,
            depth=frame.sparse[rows, columns].astype(np.float64),
            sigma_pixels=sigma,
            sigma=sigma,
        )
