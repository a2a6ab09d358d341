"""A session's state after each frame, and its way into a state file and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dyfn_core.files import OutputError
from dyfn_core.models.checkpoints import model_fingerprint
from dyfn_core.stream.depth_stream import DepthStream, StreamMemory, same_camera
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.resets import NEW_CAMERA, NEW_FRAME_ID
from dyfn_core.stream.stages import StreamStage
from dyfn_core.stream.state_file import (
    SavedStream,
    StateFileError,
    check_replaceable,
    load_stream,
    restore,
    save_stream,
)

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel


class StateError(ValueError):
    """The state cannot be saved or loaded; the text says why."""


@dataclass(frozen=True)
class StreamSettings:
    """What a DepthStream is made with, besides the camera matrix; others are another stream.

    Attributes:
        stabilize: Whether DyFN runs.
        num_tokens: Resolution inside the model; 0 is the model's own.
        frame_id: Of the frames.
    """

    stabilize: bool
    num_tokens: int
    frame_id: str = ""

    def stream(self, model: GeometryModel, camera_matrix: np.ndarray | None) -> DepthStream:
        """A stream without memory."""
        return DepthStream(
            model,
            camera_matrix,
            stabilize=self.stabilize,
            num_tokens=self.num_tokens or None,
        )


@dataclass(frozen=True)
class StreamSnapshot:
    """All of one moment between two frames; made of values that are never changed."""

    settings: StreamSettings
    camera_matrix: np.ndarray | None
    memory: StreamMemory
    stages: dict[str, Any]  # the stages' states, by the name of SavedStream's field


@dataclass(frozen=True)
class Loaded:
    """What a state file holds, ready to go on with."""

    settings: StreamSettings
    stream: DepthStream
    saved: SavedStream


class StateKeeper:
    """Remembers where a session stood after its last frame.

    Saving and loading work on these values, in the caller's thread: they neither wait for the
    network nor meet a frame half way.
    """

    def __init__(self, stages: Sequence[StreamStage], model: GeometryModel) -> None:
        self._stages = [stage for stage in stages if stage.saved_as]
        self._model = model
        self._now: StreamSnapshot | None = None

    @cached_property
    def fingerprint(self) -> str:
        """Of the model; all of its weights are read for it."""
        return model_fingerprint(self._model)

    def remember(self, settings: StreamSettings, stream: DepthStream) -> None:
        """The session stands here, between two frames."""
        states = {stage.saved_as: stage.state for stage in self._stages}
        self._now = StreamSnapshot(settings, stream.camera_matrix, stream.memory, states)

    def save(self, path: str) -> str:
        """-> what was saved. Raises StateError; an older file is then still there."""
        now = self._now
        if now is None:
            raise StateError("there is nothing to save yet: no frame has been worked on")
        stream = now.settings.stream(self._model, now.camera_matrix)
        stream.memory = now.memory
        notes = {"frame_id": now.settings.frame_id}
        try:
            check_replaceable(_checked(path))
            save_stream(_checked(path), stream, self.fingerprint, notes=notes, **now.stages)
        except StateFileError as error:
            raise StateError(str(error)) from error
        except OutputError as error:
            raise StateError(f"{error}; an older file is kept") from error
        return f"saved {now.memory.frames} frames' memory to {path}"

    def load(self, path: str, options: StreamOptions) -> Loaded:
        """Raises StateError: a damaged file, another model's, or one that does not fit."""
        try:
            saved = load_stream(_checked(path), self.fingerprint)
            if saved.memory.image_size is None:
                raise StateError("the state has no frames in it")
            if saved.scale_memory is not None and not options.scale_memory:
                raise StateError(f"{path} was saved with scale_memory, this stream has none")
            frame_id = saved.notes.get("frame_id", "")
            settings = StreamSettings(options.stabilize, options.num_tokens, frame_id)
            self._check_camera(path, saved, settings)
            stream = settings.stream(self._model, saved.camera_matrix)
            restore(stream, saved)
        except (StateError, StateFileError) as error:
            raise StateError(str(error)) from error
        except Exception as error:  # a forged description: the right kinds in wrong places
            raise StateError(f"{path} holds an unusable state: {error}") from error
        return Loaded(settings, stream, saved)

    def _check_camera(self, path: str, saved: SavedStream, settings: StreamSettings) -> None:
        """What is known of the camera must fit; what is not shows at the next frame."""
        now, reason = self._now, None
        if now is None:
            return
        (h, w), (height, width) = saved.memory.image_size or (0, 0), now.memory.image_size or (0, 0)
        if (h, w) != (height, width):
            reason = f"it is for images of {w} x {h} pixels, the camera's have {width} x {height}"
        elif settings.frame_id != now.settings.frame_id:
            reason = NEW_FRAME_ID
        elif not same_camera(saved.camera_matrix, now.camera_matrix):
            reason = NEW_CAMERA
        if reason:
            raise StateError(f"{path} does not fit this camera: {reason}")


def _checked(path: str) -> Path:
    if not path:
        raise StateError("state_file is empty, expected the path of a file")
    return Path(path).expanduser()


def check_folder(path: str, folder: str) -> None:
    """Raises StateError when a state file is not in the folder, links followed."""
    if not path:
        return
    if not folder:
        raise StateError(
            "no folder is configured for state files: give state_folder, or state_file, at start"
        )
    inside = Path(folder).expanduser().resolve()
    if not Path(path).expanduser().resolve().is_relative_to(inside):
        raise StateError(f"state_file {path} is outside of the folder for state files, {inside}")


def path_for(path: str, camera: str, shared: bool) -> str:
    """A camera's own file beside the one that several cameras share: s.safetensors ->
    s.front.safetensors."""
    if not (path and camera and shared):
        return path
    whole = Path(path)
    return str(whole.with_name(f"{whole.stem}.{camera}{whole.suffix}"))
