"""The files of `dyfn-depth`, each whole or not there."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from dyfn_core.evaluation.reconstruction.cloud_error import write_ply
from dyfn_core.evaluation.report.pictures import encode_picture
from dyfn_core.extras import missing
from dyfn_core.files import OutputError, finished_file, write_text
from dyfn_core.geometry.edges import flying_pixels
from dyfn_core.prediction import Prediction
from dyfn_ros.depth.panels import ColourRange, Panels
from dyfn_ros.depth.settings import EXR, NPZ, PER_FRAME, PICTURE, PLY, PNG, RRD, VIDEO, Writing
from dyfn_ros.depth.source import DepthSource, SourceFrame
from dyfn_ros.depth.view import FileView, LiveView
from dyfn_ros.replay.frame_spool import EDGE
from dyfn_ros.replay.mp4 import Mp4File, load_av
from dyfn_ros.replay.rerun import load_rerun

LARGEST = 65535  # of a 16-bit PNG
SUFFIXES = {PICTURE: ".png", PNG: ".png", NPZ: ".npz", EXR: ".exr", PLY: ".ply"}


class DepthOutputs:
    """Takes frames with their depth in order and writes what was asked for.

    Attributes:
        written: The files and folders, once there is something in them.
        warnings: What is not whole, with how often.
    """

    def __init__(self, writing: Writing, source: DepthSource) -> None:
        """Check that everything can be written, before a model runs.

        Raises:
            OutputError: A library is missing, or results are there and may not be replaced.
        """
        usual = (PICTURE,) if source.kind == "picture" else (VIDEO,)
        self._kinds = usual if writing.write is None else writing.write
        self._writing = writing
        self._folder = source.folder if writing.out is None else writing.out
        self._stem = f"{source.name}_depth"
        self._single = source.kind == "picture"
        self.written: list[Path] = []
        self.warnings: Counter[str] = Counter()
        _check_libraries(self._kinds, writing.view)
        if not writing.overwrite:
            self._check_places()
        self._range = ColourRange(writing.near, writing.far)
        self._panels = Panels(writing.panels, writing.video_size)
        self._names: list[dict[str, Any]] = []
        self._start: float | None = None
        self._stack = ExitStack()
        self._video: Mp4File | None = None
        self._views: list[FileView | LiveView] = []

    @property
    def _frame_kinds(self) -> list[str]:
        return [kind for kind in self._kinds if kind in PER_FRAME]

    def _place(self, kind: str) -> Path:
        """The file or, of several frames, the folder of a kind."""
        if kind in (VIDEO, RRD):
            return self._folder / f"{self._stem}{'.mp4' if kind == VIDEO else '.rrd'}"
        if self._single:
            marked = f"{self._stem}16" if kind == PNG else self._stem  # beside the picture's .png
            return self._folder / f"{marked}{SUFFIXES[kind]}"
        return self._folder / self._stem / kind

    def _check_places(self) -> None:
        for path in map(self._place, self._kinds):
            if path.exists():
                raise OutputError(f"{path} exists already; expected --overwrite or another --out")

    def __enter__(self) -> DepthOutputs:
        with ExitStack() as stack:
            if self._kinds:
                self._folder.mkdir(parents=True, exist_ok=True)
            if VIDEO in self._kinds:
                self._video = stack.enter_context(Mp4File(self._place(VIDEO)))
            if RRD in self._kinds:
                self._views.append(stack.enter_context(FileView(self._place(RRD), self._stem)))
            if self._writing.view:
                self._views.append(stack.enter_context(LiveView(self._stem, self._warn)))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, trace)
        if kind is None and self._names:
            self.written += [self._place(one) for one in self._kinds if one not in PER_FRAME]

    def _warn(self, reason: str) -> None:
        self.warnings[reason] += 1

    def write(self, frame: SourceFrame, prediction: Prediction[np.ndarray]) -> None:
        """One frame; `frame.image` is as the stream saw it."""
        self._start = frame.stamp if self._start is None else self._start
        ends = self._range.update(prediction, frame.stamp)
        drawn = None
        if {VIDEO, PICTURE} & set(self._kinds):
            drawn = self._panels.draw(frame.image, prediction, ends)
        if self._video is not None and drawn is not None:
            self._video.write(drawn, frame.stamp - self._start)
        for view in self._views:
            view.show(frame, prediction)
        for kind in self._frame_kinds:
            path = self._place(kind)
            if not self._single:
                path.mkdir(parents=True, exist_ok=True)
            if path not in self.written:
                self.written.append(path)
            path = path if self._single else path / f"{frame.name}{SUFFIXES[kind]}"
            self._write_frame(kind, path, frame, prediction, drawn)
        self._names.append(
            {"name": frame.name, "seconds": frame.stamp, "metric": prediction.metric}
        )

    def _write_frame(
        self,
        kind: str,
        path: Path,
        frame: SourceFrame,
        prediction: Prediction[np.ndarray],
        drawn: np.ndarray | None,
    ) -> None:
        if kind == PLY:
            self._cloud(path, frame, prediction)
            return
        with finished_file(path) as partial:
            if kind == PICTURE and drawn is not None:
                partial.write_bytes(encode_picture(drawn))
            elif kind == PNG:
                partial.write_bytes(self._png(prediction))
            elif kind == NPZ:
                with partial.open("wb") as file:
                    np.savez_compressed(file, **_arrays(frame, prediction))
            elif kind == EXR:
                partial.write_bytes(_exr(prediction, path))

    def _png(self, prediction: Prediction[np.ndarray]) -> bytes:
        """16-bit PNG of depth times png_values; 0 where there is none or it is too large."""
        stored = np.where(prediction.valid, prediction.depth, 0) * self._writing.png_values
        beyond = stored > LARGEST
        if beyond.any():
            limit = LARGEST / self._writing.png_values
            self.warnings[f"16-bit PNGs end at a depth of {limit:g}: farther pixels are 0"] += 1
        values = np.where(beyond, 0, np.round(stored)).astype(np.uint16)
        done, data = cv2.imencode(".png", values)
        if not done:
            raise OutputError(f"a depth map of {values.shape} cannot be encoded as PNG")
        return data.tobytes()

    def _cloud(self, path: Path, frame: SourceFrame, prediction: Prediction[np.ndarray]) -> None:
        used = solid(prediction)
        if not used.any():
            self.warnings["frames without a point have no PLY"] += 1
            return
        write_ply(path, prediction.points[used], frame.image[used])

    def finish(self, facts: dict[str, Any]) -> None:
        """Write what the files of single frames mean, as JSON beside them.

        Args:
            facts: Of the run.
        """
        if not self._frame_kinds or not self._names:
            return
        path = self._folder / f"{self._stem}.json"
        unit = {"png_values_per_unit": self._writing.png_values} if PNG in self._kinds else {}
        text = json.dumps({**facts, **unit, "frames": self._names}, indent=1, allow_nan=False)
        write_text(path, text + "\n")
        self.written.append(path)


def solid(prediction: Prediction[np.ndarray]) -> np.ndarray:
    """H x W bool: valid, and not between two surfaces, where points hang in the air."""
    valid = prediction.valid
    used: np.ndarray = valid & ~flying_pixels(np.where(valid, prediction.depth, 1), valid, EDGE)
    return used


def _check_libraries(kinds: tuple[str, ...], view: bool) -> None:
    if VIDEO in kinds:
        load_av()
    if RRD in kinds or view:
        load_rerun()
    if EXR in kinds:
        _library()


def _library() -> Any:
    try:
        import OpenEXR
    except ImportError as error:
        raise OutputError(f"writing .exr needs OpenEXR: {missing(error)}") from error
    return OpenEXR


def _exr(prediction: Prediction[np.ndarray], path: Path) -> bytes:
    """One float32 channel Z, NaN where there is no depth."""
    library = _library()
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    partial = path.with_name(f".{path.name}.writing.exr")  # the library wants the suffix
    try:
        with library.File(header, {"Z": _depth(prediction)}) as file:
            file.write(str(partial))
        return partial.read_bytes()
    except (RuntimeError, ValueError) as error:
        raise OutputError(f"{path}: cannot be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def _depth(prediction: Prediction[np.ndarray]) -> np.ndarray:
    """H x W float32, NaN where there is none."""
    return np.where(prediction.valid, prediction.depth, np.nan).astype(np.float32)


def _arrays(frame: SourceFrame, prediction: Prediction[np.ndarray]) -> dict[str, Any]:
    return {
        "depth": _depth(prediction),
        "mask": prediction.valid,
        "camera_matrix": prediction.camera_matrix,
        "metric": prediction.metric,
        "seconds": frame.stamp,
    }
