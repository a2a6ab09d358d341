"""A replay as a Rerun recording (.rrd); needs the extra `rerun`."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import Self

from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.extras import missing
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
        raise OutputError(f"the Rerun viewer and .rrd need rerun-sdk: {missing(error)}") from error
    return rerun


class RerunFile:
    """A Rerun recording that is written to a file, which appears when it is complete.

    The library writes in a thread of its own, which only logs a full disk and has been seen
    never to return from one: a disk with less than ROOM is an OutputError before that. The file is
    read back at the end, and an incomplete one is an OutputError too.

    Attributes:
        recording: The rerun.RecordingStream to log to.
    """

    def __init__(
        self, path: Path, application: str, name: str, blueprint: Callable[[Any], Any] | None = None
    ) -> None:
        """Begin the file.

        Args:
            path: The file.
            application: Name of the program, for the viewer.
            name: Of the recording.
            blueprint: Makes, of the library, what the viewer arranges; None: the viewer's own.
        """
        self._path, rerun = path, load_rerun()
        self._partial = path.with_name(f".{path.name}.partial")
        self.recording = rerun.RecordingStream(application, recording_id=name)
        self._used = False
        arranged = None if blueprint is None else blueprint(rerun)
        try:
            self.recording.save(self._partial, default_blueprint=arranged)
        except (OSError, RuntimeError) as error:
            raise OutputError(f"{path}: cannot be written: {error}") from error

    def __enter__(self) -> Self:
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

        self.recording.flush(timeout_sec=PATIENCE)
        self.recording.disconnect()
        if self._used and not RrdReader(self._partial).recordings():  # an intact index
            raise ValueError("the file holds no recording after it was written")

    def require_room(self) -> None:
        """Before a frame is logged. Raises OutputError when the disk has less than ROOM."""
        free = shutil.disk_usage(self._path.parent).free
        if free < ROOM:
            raise OutputError(
                f"{self._path}: cannot be written: {free / 2**20:.0f} MB are free, "
                f"{ROOM / 2**20:.0f} MB are needed"
            )
        self._used = True


class RerunRecording(RerunFile):
    """Entities: camera (pinhole), camera/image (JPEG), camera/depth, points; scores/NAME for each
    of score_values.

    On the timelines `stamp` and `frame`. Depth and points are in the unit of the model.
    """

    def __init__(self, path: Path, name: str) -> None:
        super().__init__(path, APPLICATION, name)
        self._frames = 0

    def write(
        self, frame: RecordedFrame, prediction: Prediction[np.ndarray], score: FrameScore
    ) -> None:
        """Everything of one frame."""
        self.require_room()
        self.recording.set_time("frame", sequence=self._frames)
        self.recording.set_time("stamp", timestamp=np.datetime64(frame.stamp_ns, "ns"))
        self._frames += 1
        values = score_values(prediction, score)
        log_frame(self.recording, frame.image, prediction, values)


def log_frame(
    recording: Any, image: np.ndarray, prediction: Prediction[np.ndarray], values: dict[str, float]
) -> None:
    """Log the entities of RerunRecording at the time that is set.

    Args:
        recording: A rerun.RecordingStream.
        image: H x W x 3 uint8 RGB.
        prediction: Of the same size.
        values: Numbers to plot, by name.
    """
    rr, log = load_rerun(), recording.log
    jpeg = encode_picture(image, ".jpg")
    log("camera/image", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))
    height, width = prediction.depth.shape
    matrix = prediction.camera_matrix
    pinhole = rr.Pinhole(image_from_camera=matrix, width=width, height=height)
    log("camera", pinhole)
    depth = np.where(prediction.valid, prediction.depth, 0).astype(np.float32)
    log("camera/depth", rr.DepthImage(depth, meter=1.0))
    points, valid, colours = subsampled(image, prediction)
    log("points", rr.Points3D(points[valid], colors=colours[valid]))
    for name, value in values.items():
        log(f"scores/{name}", rr.Scalars(value))
