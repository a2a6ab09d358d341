"""A stream's complete memory in one safetensors file, to go on with after a restart."""

from __future__ import annotations

import hashlib
import json
import math
import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from dyfn_core.files import finished_file
from dyfn_core.geometry.key_points import KeyPoints
from dyfn_core.geometry.tracks import TrackerState, Tracks
from dyfn_core.metric.calibration import ScaleCalibration, ScalePrior
from dyfn_core.metric.fit import MetricMap
from dyfn_core.metric.motion import MotionState, View
from dyfn_core.metric.motion_scale import MotionScaleState
from dyfn_core.metric.point_memory import PointMemory
from dyfn_core.metric.references import Evidence
from dyfn_core.metric.scale_filter import FilterState
from dyfn_core.metric.scale_memory import ScaleMemoryState, SeenFrame
from dyfn_core.prediction import StreamState
from dyfn_core.stream.depth_stream import DepthStream, MeanState, StreamMemory
from dyfn_core.stream.plain_values import from_plain, to_plain
from dyfn_core.stream.scene_cut import CutState, PictureFeatures

FORMAT = "dyfn-stream 1"
LARGEST = 1 << 28  # bytes; the state of the largest model and picture has a tenth of it


class StateFileError(ValueError):
    """A state file that cannot be read, or that belongs to something else; the text says what."""


@dataclass(frozen=True)
class SavedStream:
    """What a state file holds.

    memory: the DepthStream's. camera_matrix: 3 x 3 float64 pixels, or None.
    calibration: of the metric scale; cut: of the scene cut detector; motion: of the scale from the
    camera's motion; model_scale: of the scale that the model says; scale_memory: of the scale from
    the pictures; None when there is none.
    options: what the stream was made with. notes: the caller's own, text to text.
    """

    memory: StreamMemory
    camera_matrix: np.ndarray | None
    calibration: ScaleCalibration | None = None
    cut: CutState | None = None
    motion: MotionScaleState | None = None
    options: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    model_scale: FilterState | None = None
    scale_memory: ScaleMemoryState | None = None


# The names are a part of the format: a class that is renamed keeps the name that files have.
_KINDS: dict[str, type] = {
    "SavedStream": SavedStream,
    "StreamMemory": StreamMemory,
    "StreamState": StreamState,
    "Track": MeanState,
    "Calibration": ScaleCalibration,
    "MetricMap": MetricMap,
    "Evidence": Evidence,
    "CutState": CutState,
    "Look": PictureFeatures,
    "ScalePrior": ScalePrior,
    "MotionScaleState": MotionScaleState,
    "MotionState": MotionState,
    "View": View,
    "TrackerState": TrackerState,
    "Tracks": Tracks,
    "PointMemory": PointMemory,
    "FilterState": FilterState,
    "ScaleMemoryState": ScaleMemoryState,
    "SeenFrame": SeenFrame,
    "KeyPoints": KeyPoints,
}


def stream_options(stream: DepthStream) -> dict[str, Any]:
    """What two streams must share for one to go on with the memory of the other."""
    filters = {"shift_filter": stream.shift_filter, "focal_filter": stream.focal_filter}
    return {
        "stabilize": stream.stabilize,
        "num_tokens": stream.num_tokens,
        "shift_mode": stream.shift_mode,
        "force_projection": stream.force_projection,
        **{name: [one.gain, one.clip] for name, one in filters.items()},
    }


def save_stream(
    path: str | Path,
    stream: DepthStream,
    fingerprint: str,
    *,
    calibration: ScaleCalibration | None = None,
    cut: CutState | None = None,
    motion: MotionScaleState | None = None,
    model_scale: FilterState | None = None,
    scale_memory: ScaleMemoryState | None = None,
    notes: Mapping[str, str] | None = None,
) -> None:
    """Write a stream's state, whole or not at all: an older file stays until then.

    fingerprint: of the stream's model, see dyfn_core.models.checkpoints.model_fingerprint.
    Raises OutputError (no such folder, disk full); the old file is then as it was.
    """
    saved = SavedStream(
        stream.memory,
        stream.camera_matrix,
        calibration,
        cut,
        motion,
        stream_options(stream),
        dict(notes or {}),
        model_scale,
        scale_memory,
    )
    tensors: dict[str, Tensor] = {}
    content = json.dumps(
        {"model": fingerprint, "state": to_plain(saved, tensors, _KINDS)}, sort_keys=True
    )
    metadata = {"format": FORMAT, "content": content, "digest": _digest(content, tensors)}
    with finished_file(Path(path), durable=True) as partial:
        partial.write_bytes(save_tensors(tensors, metadata))


def load_stream(path: str | Path, fingerprint: str) -> SavedStream:
    """Read a state file. fingerprint: of the model that is to go on with it.

    Raises StateFileError naming the file: absent, unreadable, damaged, of another format, or
    another model's.
    """
    path = Path(path)
    data = _read(path)
    try:
        metadata = _metadata(data)
        tensors = load_tensors(data)
    except (SafetensorError, ValueError, KeyError, RecursionError) as error:
        raise StateFileError(f"{path} is damaged, or no state file: {error}") from error
    if metadata.get("format") != FORMAT:
        raise StateFileError(
            f"{path} has format {metadata.get('format')!r}, expected a stream state {FORMAT!r}"
        )
    content = metadata.get("content", "")
    if metadata.get("digest") != _digest(content, tensors):
        raise StateFileError(f"{path} is damaged: its content does not fit its digest")
    try:
        described = json.loads(content)
        model, state = described["model"], from_plain(described["state"], tensors, _KINDS)
    except Exception as error:  # whatever a stranger's description may raise
        raise StateFileError(f"{path}: the description of the state is bad: {error}") from error
    if model != fingerprint:
        raise StateFileError(
            f"{path} is the state of another model ({model[:12]}), this one is {fingerprint[:12]}"
        )
    if not isinstance(state, SavedStream):
        raise StateFileError(f"{path} holds a {type(state).__name__}, expected a SavedStream")
    try:
        _check_numbers(state.memory)
    except Exception as error:
        raise StateFileError(f"{path} holds an unusable state: {error}") from error
    return state


def _read(path: Path) -> bytes:
    """All of a regular file of at most LARGEST bytes. Raises StateFileError."""
    try:
        # A pipe that nobody writes to would otherwise block for ever.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(handle, "rb") as file:
            found = os.fstat(handle)
            if not stat.S_ISREG(found.st_mode):
                raise StateFileError(f"{path} is no regular file")
            if found.st_size > LARGEST:
                raise StateFileError(
                    f"{path} has {found.st_size} bytes, a state has at most {LARGEST}"
                )
            return file.read(LARGEST)
    except OSError as error:
        raise StateFileError(f"cannot read {path}: {error.strerror or error}") from error


def check_replaceable(path: Path) -> None:
    """Raises StateFileError when there is something that is no state file of ours."""
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not path.is_file():
        raise StateFileError(f"{path} is no regular file, it is not replaced")
    try:
        ours = _metadata(_read(path)).get("format", "").startswith(FORMAT.split()[0])
    except (ValueError, KeyError, AttributeError, RecursionError):
        ours = False
    if not ours:
        raise StateFileError(f"{path} is no state file, it is not replaced")


def _check_numbers(memory: StreamMemory) -> None:
    """A memory of NaN would give NaN for ever."""
    hidden = None if memory.state is None else memory.state.hidden
    if hidden is not None and not torch.isfinite(hidden).all():
        raise ValueError("DyFN's hidden state is not finite")
    for name, mean in (("focal", memory.focal), ("shift", memory.shift)):
        if mean is not None and not (math.isfinite(mean.value) and math.isfinite(mean.spread)):
            raise ValueError(f"the {name} is not finite")
    if memory.unit is not None and not (math.isfinite(memory.unit) and memory.unit > 0):
        raise ValueError(f"the unit is {memory.unit}")


def restore(stream: DepthStream, saved: SavedStream) -> None:
    """Go on where the saved stream was. Raises StateFileError naming an option that differs;
    the stream is then as it was."""
    own = stream_options(stream)
    for name, value in own.items():
        if saved.options.get(name) != value:
            raise StateFileError(
                f"the state was saved with {name} = {saved.options.get(name)!r}, "
                f"this stream has {value!r}"
            )
    stream.camera_matrix = saved.camera_matrix
    state = saved.memory.state
    state = None if state is None else state.to(stream.model.device)
    # The time between saving and loading is no gap between two frames.
    stream.memory = replace(saved.memory, state=state, stamp=None)


def _metadata(data: bytes) -> dict[str, str]:
    """The text entries of a safetensors file in memory; its header is JSON after eight bytes."""
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > len(data) - 8:
        raise ValueError(f"{len(data)} bytes are too few")
    header = json.loads(data[8 : 8 + length])
    return dict(header.get("__metadata__", {}))


def _digest(content: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(content.encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"{name} {value.dtype} {tuple(value.shape)};".encode())
        digest.update(value.contiguous().numpy().tobytes())
    return digest.hexdigest()
