"""~/save_state and ~/load_state: a camera's whole memory on disk and back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from dyfn_core.stream.session import (
    Geometry,
    StreamFrame,
    StreamHook,
    StreamKey,
    StreamSession,
)

if TYPE_CHECKING:
    from dyfn_core.metric.calibration import ScaleCalibration
    from dyfn_core.models.base import GeometryModel
    from dyfn_core.stream.scene_cut_hook import SceneCutHook
    from dyfn_core.stream.state_file import SavedStream


class StateError(ValueError):
    """The state cannot be saved or loaded; the text says why."""


class Calibrated(Protocol):
    """A hook that holds a metric calibration; `state` is all that it remembers."""

    @property
    def state(self) -> ScaleCalibration: ...

    def restore(self, state: ScaleCalibration | None) -> None: ...


@dataclass(frozen=True)
class _Checkpoint:
    """All of one moment between two frames; made of values that are never changed."""

    key: StreamKey
    memory: Any
    calibration: Any
    cut: Any


@dataclass(frozen=True)
class _Loaded:
    key: StreamKey
    stream: Any
    saved: SavedStream
    epoch: int


class StateHook(StreamHook):
    """The last of a camera's hooks: it remembers where the stream stood after each frame.

    Saving and loading work in the caller's thread on these values, so they neither wait for the
    network nor meet a frame half way.
    """

    def __init__(
        self, stream: StreamSession, metric: Calibrated, cut: SceneCutHook, model: GeometryModel
    ) -> None:
        from dyfn_core.stream.state_file import model_fingerprint

        self._stream, self._metric, self._cut = stream, metric, cut
        self._fingerprint = model_fingerprint(model)
        self._checkpoint: _Checkpoint | None = None
        self._loaded: deque[_Loaded] = deque(maxlen=1)

    def after_prediction(self, frame: StreamFrame, geometry: Geometry) -> Geometry:
        """See StreamHook."""
        memory = self._stream.stream.memory
        self._checkpoint = _Checkpoint(frame.key, memory, self._metric.state, self._cut.state)
        return geometry

    def save(self, path: str) -> str:
        """-> what was saved. Raises StateError; an older file is then still there."""
        from dyfn_core.stream.state_file import save_stream

        now = self._checkpoint
        if now is None:
            raise StateError("there is nothing to save yet: no frame has been worked on")
        stream = self._stream.make(now.key)
        stream.memory = now.memory
        try:
            save_stream(
                _checked(path),
                stream,
                self._fingerprint,
                calibration=now.calibration,
                cut=now.cut,
                notes={"frame_id": now.key.frame_id},
            )
        except OSError as error:
            reason = error.strerror or str(error)
            raise StateError(f"cannot write {path}: {reason}; an older file is kept") from error
        return f"saved {now.memory.frames} frames' memory to {path}"

    def load(self, path: str, begin: Callable[[], int], stabilize: bool, num_tokens: int) -> str:
        """Take effect with the first frame after this call. -> what was loaded.

        begin: called when the file is good, -> the number of the epoch that starts with it.
        Raises StateError: a damaged file, another model's, or one that does not fit the camera.
        """
        from dyfn_core.stream.state_file import StateFileError, load_stream, restore

        try:
            saved = load_stream(_checked(path), self._fingerprint)
            key = _key(saved, stabilize, num_tokens)
            self._check_camera(path, key)
            stream = self._stream.make(key)
            restore(stream, saved)
        except StateFileError as error:
            raise StateError(str(error)) from error
        self._loaded.append(_Loaded(key, stream, saved, begin()))
        return f"goes on after {saved.memory.frames} frames from {path}"

    def _check_camera(self, path: str, key: StreamKey) -> None:
        """What is known of the camera must fit; what is not shows at the next frame."""
        now = self._checkpoint
        if now is None or (reason := key.difference(now.key)) is None:
            return
        (h, w), (height, width) = key.size, now.key.size
        if key.size != now.key.size:
            reason = f"it is for images of {w} x {h} pixels, the camera's have {width} x {height}"
        raise StateError(f"{path} does not fit this camera: {reason}")

    def adopt(self, frame: StreamFrame) -> tuple[StreamKey, Any, int] | None:
        """Inference thread, before anything else of a frame -> key, stream, epoch to go on with."""
        if not self._loaded or frame.epoch < self._loaded[0].epoch:
            return None
        loaded = self._loaded.popleft()
        self._metric.restore(loaded.saved.calibration)
        self._cut.restore(loaded.saved.cut)
        return loaded.key, loaded.stream, loaded.epoch

    def report(self) -> dict[str, str]:
        """See StreamHook."""
        return {"model fingerprint": self._fingerprint[:12]}


def _checked(path: str) -> Path:
    if not path:
        raise StateError("the parameter state_file is empty, expected the path of a file")
    return Path(path).expanduser()


def _key(saved: SavedStream, stabilize: bool, num_tokens: int) -> StreamKey:
    """What the saved stream was made for, with the settings in force."""
    size = saved.memory.image_size
    if size is None:
        raise StateError("the state has no frames in it")
    matrix = saved.camera_matrix
    numbers = None if matrix is None else tuple(np.reshape(matrix, -1).tolist())
    return StreamKey(size, numbers, stabilize, num_tokens, saved.notes.get("frame_id", ""))


def path_for(path: str, camera: str, shared: bool) -> str:
    """A camera's own file beside the one that several cameras share: s.safetensors ->
    s.front.safetensors."""
    if not (path and camera and shared):
        return path
    whole = Path(path)
    return str(whole.with_name(f"{whole.stem}.{camera}{whole.suffix}"))
