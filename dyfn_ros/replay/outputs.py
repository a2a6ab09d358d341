"""The outputs of a replay that a user can choose: recording, cloud, video, Rerun recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol

import numpy as np

from dyfn_core.evaluation.report.cloud_view import CloudView
from dyfn_core.files import cannot_write
from dyfn_core.metric.pose_agreement import PoseAgreement
from dyfn_core.metric.pose_history import SECOND
from dyfn_core.prediction import Prediction
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_ros.recordings.open import RecordedFrame
from dyfn_ros.recordings.poses import PoseError, PoseLookup, open_poses
from dyfn_ros.replay.cloud import FusedCloud, cloud_view, write_cloud
from dyfn_ros.replay.frame_spool import FrameSpool
from dyfn_ros.replay.mcap import ReplayRecording
from dyfn_ros.replay.pose_feed import pose_doubts
from dyfn_ros.replay.rerun import RerunRecording
from dyfn_ros.replay.settings import FILES, LAYOUT, MCAP, NONE, PLY, RAW, RRD, VIDEO, Outputs
from dyfn_ros.replay.shown_run import ShownRun
from dyfn_ros.replay.video import write_video


@contextmanager
def _written(path: Path) -> Iterator[None]:
    """Names the file that cannot be written."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from error


class _Writer(Protocol):
    def write(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], score: FrameScore
    ) -> None: ...


class ReplayOutputs:
    """Takes a replay's frames and leaves the chosen files in a folder, each only when complete.

    options: folder, files and their parameters. recording: what is replayed; its poses are looked
    for in it, stamps: by which of their times. expected_frames: how many there will be. warn: takes
    a reason for what is not written, or not whole. doubts: after finish, what makes the poses
    implausible. After an exception none
    of the files is left behind. cloud: after finish, clouds for the report, if copies of the
    frames were kept. Raises OutputError for a file that cannot be written, or a library
    that is missing.
    """

    def __init__(
        self,
        options: Outputs,
        recording: Path,
        expected_frames: int,
        warn: Callable[[str], None],
        stamps: Literal["header", "log"] = "header",
    ) -> None:
        self._options, self._recording, self._warn = options, recording, warn
        self._stamps, self._agreement = stamps, PoseAgreement(expected_frames)
        self.doubts: list[str] = []
        self._folder = options.folder
        self._writers: list[tuple[Path, _Writer]] = []
        self._spool: FrameSpool | None = None
        self._poses: PoseLookup | None = None
        self._notes: list[str] = []
        self._fuse = PLY in options.write
        self._posed = bool({MCAP, RAW, PLY} & set(options.write))
        self._mcap: ReplayRecording | None = None
        self._done = {MCAP, RAW, RRD} & set(options.write)
        self._stack = ExitStack()
        self.cloud: CloudView | None = None

    def __enter__(self) -> ReplayOutputs:
        with ExitStack() as stack:
            if {MCAP, RAW} & set(self._options.write):
                path, raw = self._folder / FILES[MCAP], RAW in self._options.write
                self._mcap = stack.enter_context(ReplayRecording(path, raw=raw))
            if RRD in self._options.write:
                path = self._folder / FILES[RRD]
                rerun = RerunRecording(path, self._recording.name)
                self._writers.append((path, stack.enter_context(rerun)))
            if {MCAP, PLY, VIDEO} & set(self._options.write):
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
            if self._mcap is not None:
                self._mcap.write_layout(self._folder / LAYOUT)
            made = {FILES[name] for name in self._done} | ({LAYOUT} if self._mcap else set())
            for name in {*FILES.values(), LAYOUT} - made:  # of an earlier run, not of these frames
                (self._folder / name).unlink(missing_ok=True)

    def write(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], score: FrameScore
    ) -> None:
        """One frame, in order."""
        pose = self._pose(frame) if self._posed else None
        if self._mcap is not None:
            with _written(self._folder / FILES[MCAP]):
                self._mcap.write(frame, prediction, score, pose)
        for path, writer in self._writers:
            with _written(path):
                writer.write(frame, prediction, score)
        if self._spool is not None:
            self._spool.push(frame, prediction, pose)

    def write_base(self, prediction: Prediction[np.ndarray]) -> None:
        """What the base model predicts of the next frame, in order, after all of write."""
        if self._spool is not None:
            self._spool.push_base(prediction)

    def finish(self, runs: Sequence[ShownRun]) -> None:
        """Write what needs the alignment of the whole sequence.

        Args:
            runs: The run; and the base model's, where write_base took it.
        """
        spool, fused = self._spool, None
        if self._mcap is not None:
            with _written(self._folder / FILES[MCAP]):
                raw = RAW in self._options.write
                self._mcap.finish(None if raw else spool, runs[0])
            self._notes += self._mcap.notes
        if spool is not None and spool.frames:
            if VIDEO in self._options.write:
                write_video(self._folder / FILES[VIDEO], spool, runs)
                self._done.add(VIDEO)
            if self._fuse:
                fused = self._write_cloud(spool, runs[0])
            options = self._options
            self.cloud = cloud_view(spool, fused, runs, options.voxel, options.depth_max)
        for note in self._notes:
            self._warn(note)
        if (poses := self._poses) is not None:
            offset = round(self._options.pose_offset * SECOND)
            found = self._agreement.judge(lambda stamp: poses(-1, stamp + offset))
            name = self._options.pose_topic or "poses"
            self.doubts = pose_doubts(found, name, "--pose-offset", self._options.pose_offset)

    def _write_cloud(self, spool: FrameSpool, run: ShownRun) -> FusedCloud | None:
        path, options = self._folder / FILES[PLY], self._options
        if not run.alignment.metres:
            self._notes.append(
                "no cloud.ply: depth is up to scale, and no ground truth gives its metres"
            )
            return None
        fused, note = write_cloud(path, spool, run.alignment, options.voxel, options.depth_max)
        self._done.add(PLY)
        self._notes += [note] if note else []
        return fused

    def _pose(self, frame: RecordedFrame) -> np.ndarray | None:
        """Poses are opened with the first frame, which knows the camera's frame_id."""
        if self._poses is None:
            topic = self._options.pose_topic
            try:
                self._poses = open_poses(self._recording, frame.frame_id, topic, self._stamps)
            except PoseError as error:
                if topic not in (None, NONE):
                    raise
                if self._fuse:
                    self._notes.append(f"no cloud.ply: {error}")
                self._fuse = self._posed = False
                return None
        self._agreement.push(frame.image, frame.stamp_ns, frame.camera_matrix)
        offset = round(self._options.pose_offset * SECOND)
        return self._poses(frame.index, frame.stamp_ns + offset)
