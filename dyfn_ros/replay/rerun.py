"""A replay as a Rerun recording (.rrd); needs the extra `rerun`."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.files import OutputError
from dyfn_core.prediction import Prediction
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_ros.recordings.open import RecordedFrame
from dyfn_ros.replay.mcap import score_values, subsampled

APPLICATION = "dyfn_replay"
PATIENCE = 60.0  # seconds for the library's thread to write what it still holds
ROOM = 64 * 2**20  # bytes that must be free on the disk before a frame


def load_rerun() -> Any:
    """The library. Raises OutputError that says what to install."""
    try:
        import rerun
    except ImportError as error:
        raise OutputError(
            f"writing .rrd needs rerun-sdk ({error}): install this package with its `rerun` extra"
        ) from error
    return rerun


class RerunRecording:
    """Entities: camera (pinhole), camera/image (JPEG), camera/depth, points; scores/NAME for each
    of score_values.

    On the timelines `stamp` and `frame`. Depth and points are in the unit of the model.
    The library writes in a thread of its own, which only logs a full disk and has been seen
    never to return from one: a disk with less than ROOM is an OutputError before that. The file is
    read back at the end, and an incomplete one is an OutputError too.
    """

    def __init__(self, path: Path, name: str) -> None:
        self._path = path
        self._rerun = load_rerun()
        self._partial = path.with_name(f".{path.name}.partial")
        self._recording = self._rerun.RecordingStream(APPLICATION, recording_id=name)
        self._frames = 0
        try:
            self._recording.save(self._partial)
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{path}: cannot be written: {error}") from error

    def __enter__(self) -> RerunRecording:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self._end()
        except (OSError, RuntimeError, ValueError) as problem:
            if kind is None:
                raise OutputError(f"{self._path}: cannot be written: {problem}") from problem
        else:
            if kind is None:
                self._partial.replace(self._path)
        finally:
            self._partial.unlink(missing_ok=True)

    def _end(self) -> None:
        from rerun.chunk import RrdReader

        self._recording.flush(timeout_sec=PATIENCE)
        self._recording.disconnect()
        if self._frames and not RrdReader(self._partial).recordings():  # an intact index
            raise ValueError("the file holds no recording after it was written")

    def write(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], score: FrameScore
    ) -> None:
        """Everything of one frame."""
        free = shutil.disk_usage(self._path.parent).free
        if free < ROOM:
            raise OutputError(
                f"{self._path}: cannot be written: {free / 2**20:.0f} MB are free, "
                f"{ROOM / 2**20:.0f} MB are needed"
            )
        rr, log = self._rerun, self._recording.log
        self._recording.set_time("frame", sequence=self._frames)
        self._recording.set_time("stamp", timestamp=np.datetime64(frame.stamp_ns, "ns"))
        self._frames += 1
        jpeg = encode_picture(frame.image, ".jpg")
        log("camera/image", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
        height, width = prediction.depth.shape
        matrix = prediction.camera_matrix
        pinhole = rr.Pinhole(image_from_camera=matrix, width=width, height=height)
        log("camera", pinhole)
        depth = np.where(prediction.valid, prediction.depth, 0).astype(np.float32)
        log("camera/depth", rr.DepthImage(depth, meter=1.0))
        points, valid, colours = subsampled(frame, prediction)
        log("points", rr.Points3D(points[valid], colors=colours[valid]))
        for name, value in score_values(prediction, score).items():
            log(f"scores/{name}", rr.Scalars(value))
