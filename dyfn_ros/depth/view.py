"""A run in the Rerun viewer: live, or as a file."""

from __future__ import annotations

import math
import os
import socket
import sys
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from dyfn_core.files import OutputError
from dyfn_core.prediction import Prediction
from dyfn_ros.depth.source import SourceFrame
from dyfn_ros.replay.rerun import RerunFile, load_rerun, log_frame

APPLICATION = "dyfn_depth"
_PORT = 9876  # of the viewer
_DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
SHOWN = 960  # pixels of the longer side of what the viewer gets
PATIENCE = 20.0  # seconds for the viewer to answer
MEMORY = "2GB"  # that the viewer keeps; older frames go


def blueprint(rerun: Any) -> Any:
    """Image and depth left, points and the scale over time right."""
    views = rerun.blueprint
    pictures = views.Vertical(
        views.Spatial2DView(origin="camera/image", name="image"),
        views.Spatial2DView(origin="camera/depth", name="depth"),
    )
    plots = views.Vertical(
        views.Spatial3DView(origin="/", contents=["/points", "/camera"], name="points"),
        views.TimeSeriesView(origin="scores", name="scale over time"),
        row_shares=[3, 1],
    )
    return views.Blueprint(views.Horizontal(pictures, plots, column_shares=[2, 3]))


class _View:
    """Shows frames on a stream of Rerun."""

    def __init__(self, recording: Any) -> None:
        self._recording, self._frames = recording, 0

    def show(self, frame: SourceFrame, prediction: Prediction[np.ndarray]) -> None:
        """One frame, in order."""
        self._recording.set_time("frame", sequence=self._frames)
        self._recording.set_time("seconds", duration=frame.stamp)
        self._frames += 1
        image, small = _shrunk(frame.image, prediction)
        log_frame(self._recording, image, small, scale_values(prediction))


def scale_values(prediction: Prediction[np.ndarray]) -> dict[str, float]:
    """What tells a steady scale: the median depth, in metres where it is known."""
    values: dict[str, float] = {}
    median = median_depth(prediction)
    if not math.isnan(median):
        values["median_depth_m" if prediction.metric else "median_depth"] = median
    if prediction.metric and prediction.unit > 0:
        values["metres_per_unit"] = float(prediction.unit)
    return values


def median_depth(prediction: Prediction[np.ndarray]) -> float:
    """Of the valid pixels; NaN where there is none."""
    valid = prediction.valid
    return float(np.median(prediction.depth[valid])) if valid.any() else math.nan


def _shrunk(
    image: np.ndarray, prediction: Prediction[np.ndarray]
) -> tuple[np.ndarray, Prediction[np.ndarray]]:
    """Every s-th pixel of what is larger than SHOWN."""
    step = math.ceil(max(image.shape[:2]) / SHOWN)
    if step == 1:
        return image, prediction
    grid = (slice(step // 2, None, step),) * 2
    small = replace(
        prediction,
        points=prediction.points[grid],
        depth=prediction.depth[grid],
        mask=prediction.mask[grid],
        known_camera=None,  # the normalised intrinsics hold for any size
    )
    return image[grid], small


@contextmanager
def _own_commands() -> Iterator[None]:
    """Commands beside this Python are found, also where its environment is not activated."""
    before = os.environ.get("PATH", "")
    os.environ["PATH"] = os.pathsep.join(filter(None, [sysconfig.get_path("scripts"), before]))
    try:
        yield
    finally:
        os.environ["PATH"] = before


def _running() -> bool:
    """Whether a viewer is there already, which then shows the run."""
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(("127.0.0.1", _PORT)) == 0


class LiveView(_View):
    """A viewer's window, which stays open when the run ends.

    A viewer that is closed meanwhile does not end the run.
    """

    def __init__(self, name: str, warn: Callable[[str], None]) -> None:
        """Open the viewer.

        Args:
            name: Of the recording.
            warn: Takes what went wrong with the viewer after that.

        Raises:
            OutputError: It cannot be opened, or does not answer, as without a display.
        """
        rerun = load_rerun()
        if sys.platform == "linux" and not any(map(os.environ.get, _DISPLAYS)) and not _running():
            raise OutputError(
                f"--view: the Rerun viewer needs a display, and none of {', '.join(_DISPLAYS)} is "
                "set; `--write rrd` makes a file for a viewer elsewhere"
            )
        recording = rerun.RecordingStream(APPLICATION, recording_id=name)
        try:
            with _own_commands():
                recording.spawn(port=_PORT, memory_limit=MEMORY, default_blueprint=blueprint(rerun))
            recording.flush(timeout_sec=PATIENCE)
        except (OSError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise OutputError(
                f"--view: the Rerun viewer cannot be opened ({reason}); it needs a display"
            ) from error
        super().__init__(recording)
        self._warn = warn

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._recording.flush(timeout_sec=PATIENCE)
        except RuntimeError:
            self._warn("--view: the Rerun viewer was closed before the end")
        self._recording.disconnect()


class FileView(_View):
    """The same as a file for the viewer."""

    def __init__(self, path: Path, name: str) -> None:
        """Begin the file. Raises OutputError."""
        self._file = RerunFile(path, APPLICATION, name, blueprint)
        super().__init__(self._file.recording)

    def __enter__(self) -> FileView:
        self._file.__enter__()
        return self

    def show(self, frame: SourceFrame, prediction: Prediction[np.ndarray]) -> None:
        """One frame, in order. Raises OutputError when the disk is nearly full."""
        self._file.require_room()
        super().show(frame, prediction)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.__exit__(kind, error, trace)
