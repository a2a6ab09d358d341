"""The outputs of a replay that a user can choose: recording, cloud, video, Rerun recording."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Protocol

import numpy as np

from dyfn_core.files import cannot_write
from dyfn_core.prediction import DEPTH, Prediction
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_ros.recordings.open import RecordedFrame
from dyfn_ros.recordings.poses import PoseError, PoseLookup, open_poses
from dyfn_ros.replay.cloud import write_cloud
from dyfn_ros.replay.frame_spool import FrameSpool
from dyfn_ros.replay.mcap import ReplayRecording
from dyfn_ros.replay.rerun import RerunRecording
from dyfn_ros.replay.settings import FILES, MCAP, NONE, PLY, RRD, VIDEO, Outputs
from dyfn_ros.replay.video import Alignment, write_video


class _Writer(Protocol):
    def write(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], score: FrameScore
    ) -> None: ...


class ReplayOutputs:
    """Takes a replay's frames and leaves the chosen files in a folder, each only when complete.

    options: folder, files and their parameters. recording: what is replayed; its poses are looked
    for in it. warn: takes a reason for what is not written, or not whole. After an exception none
    of the files is left behind. cloud: after finish, the fused cloud seen from above (H x W x 3
    uint8 RGB), if there is one. Raises OutputError for a file that cannot be written, or a library
    that is missing.
    """

    def __init__(
        self,
        options: Outputs,
        recording: Path,
        warn: Callable[[str], None],
    ) -> None:
        self._options, self._recording, self._warn = options, recording, warn
        self._folder = options.folder
        self._writers: list[tuple[Path, _Writer]] = []
        self._spool: FrameSpool | None = None
        self._poses: PoseLookup | None = None
        self._notes: list[str] = []
        self._fuse = PLY in options.write
        self._done = {MCAP, RRD} & set(options.write)
        self._stack = ExitStack()
        self.cloud: np.ndarray | None = None

    def __enter__(self) -> ReplayOutputs:
        with ExitStack() as stack:
            if MCAP in self._options.write:
                path = self._folder / FILES[MCAP]
                self._writers.append((path, stack.enter_context(ReplayRecording(path))))
            if RRD in self._options.write:
                path = self._folder / FILES[RRD]
                rerun = RerunRecording(path, self._recording.name)
                self._writers.append((path, stack.enter_context(rerun)))
            if {PLY, VIDEO} & set(self._options.write):
                self._spool = stack.enter_context(FrameSpool(self._folder))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._stack.__exit__(kind, error, trace)
        except OSError as problem:
            raise cannot_write(self._folder, problem) from problem
        if kind is None:
            for name in FILES.keys() - self._done:  # of an earlier run: not of these frames
                (self._folder / FILES[name]).unlink(missing_ok=True)

    def write(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], score: FrameScore
    ) -> None:
        """One frame, in order."""
        for path, writer in self._writers:
            try:
                writer.write(frame, prediction, score)
            except OSError as error:
                raise cannot_write(path, error) from error
        if self._spool is not None:
            pose = self._pose(frame) if self._fuse else None
            self._spool.push(frame, prediction, pose)

    def finish(self, alignment: Alignment | None, quantity: str = DEPTH) -> None:
        """Write what needs the alignment of the whole sequence; None when there is no truth.

        quantity: what the model predicts, depth or disparity.
        """
        spool = self._spool
        if spool is not None and spool.frames and VIDEO in self._options.write:
            unaligned = Alignment(quantity=quantity)
            write_video(self._folder / FILES[VIDEO], spool, alignment or unaligned)
            self._done.add(VIDEO)
        if spool is not None and spool.frames and self._fuse:
            self._write_cloud(spool, alignment)
        for note in self._notes:
            self._warn(note)

    def _write_cloud(self, spool: FrameSpool, alignment: Alignment | None) -> None:
        path, options = self._folder / FILES[PLY], self._options
        if alignment is None:
            note = "no cloud.ply: depth is up to scale, and no ground truth gives its metres"
        else:
            self.cloud, note = write_cloud(path, spool, alignment, options.voxel, options.depth_max)
            self._done.add(PLY)
        self._notes += [note] if note else []

    def _pose(self, frame: RecordedFrame) -> np.ndarray | None:
        """Poses are opened with the first frame, which knows the camera's frame_id."""
        if self._poses is None:
            topic = self._options.pose_topic
            try:
                self._poses = open_poses(self._recording, frame.frame_id, topic)
            except PoseError as error:
                if topic not in (None, NONE):
                    raise
                self._fuse = False
                self._notes.append(f"no cloud.ply: {error}")
                return None
        return self._poses(frame.index, frame.stamp_ns)
