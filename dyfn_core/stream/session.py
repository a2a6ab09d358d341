"""One camera's frames through a DepthStream that starts anew when what it depends on changes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from dyfn_core.geometry.camera import pixel_intrinsics, valid_depth

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel
    from dyfn_core.prediction import Prediction
    from dyfn_core.stream.depth_stream import DepthStream

REQUESTED = "reset service"
TIME_JUMP = "ROS time jumped"
BACKWARDS = "stamp went back"
GAP = "gap between stamps"
NEW_SIZE = "image size changed"
NEW_FRAME_ID = "frame_id changed"
NEW_CAMERA = "intrinsics changed"
NEW_SETTINGS = "settings changed"
FAILED = "inference failed"


@dataclass(frozen=True)
class StreamKey:
    """What a stream is made for; another key is another stream.

    size: (H, W). camera_matrix: the nine intrinsics in pixels, None when unknown.
    num_tokens: 0 for the model's own.
    """

    size: tuple[int, int]
    camera_matrix: tuple[float, ...] | None
    stabilize: bool
    num_tokens: int
    frame_id: str = ""

    def difference(self, other: StreamKey) -> str | None:
        """The reason to start anew when `other` came before; None when they are equal."""
        if self.size != other.size:
            return NEW_SIZE
        if self.frame_id != other.frame_id:
            return NEW_FRAME_ID
        if self.camera_matrix != other.camera_matrix:
            return NEW_CAMERA
        return None if self == other else NEW_SETTINGS


@dataclass(frozen=True)
class StreamFrame:
    """One image on its way through a stream.

    image: H x W x 3 uint8 RGB. camera_matrix: 3 x 3 pixels or None. stamp: seconds.
    visible: H x W bool, where there is a picture; None: everywhere.
    epoch: the number of resets that were asked for before the frame; request: why, for the last.
    """

    image: np.ndarray
    camera_matrix: np.ndarray | None = None
    visible: np.ndarray | None = None
    stamp: float | None = None
    frame_id: str = ""
    stabilize: bool = True
    num_tokens: int = 0
    epoch: int = 0
    request: str = REQUESTED

    @property
    def key(self) -> StreamKey:
        """What its stream must be made for."""
        matrix = self.camera_matrix
        numbers = None if matrix is None else tuple(matrix.reshape(-1).tolist())
        size = (self.image.shape[0], self.image.shape[1])
        return StreamKey(size, numbers, self.stabilize, self.num_tokens, self.frame_id)


@dataclass(frozen=True)
class Geometry:
    """Arrays of one frame, at its resolution.

    points: H x W x 3 float32. depth: H x W float32. valid: H x W bool.
    camera_matrix: 3 x 3 float64, pixels: the given one, else the model's estimate.
    reset: why the stream started anew with this frame; None when it went on (or was the first).
    metric: whether points and depth are in metres; else they are right up to one scale.
    disparity: H x W float32, what a disparity model said: right up to scale and shift, and depth
        is its inverse only as far as that shift is 0. None for other models.
    """

    points: np.ndarray
    depth: np.ndarray
    valid: np.ndarray
    camera_matrix: np.ndarray
    reset: str | None = None
    metric: bool = False
    disparity: np.ndarray | None = None

    @property
    def said(self) -> tuple[np.ndarray, np.ndarray]:
        """What is aligned to truth, H x W, and where it is valid: depth; or disparity, also where
        its inverse is too far to be depth."""
        if self.disparity is not None:
            return self.disparity, np.isfinite(self.disparity)
        return self.depth, self.valid

    def scaled(self, scale: float) -> Geometry:
        """The same in metres: points and depth times the metres of one unit."""
        factor = np.float32(scale)
        return replace(self, points=self.points * factor, depth=self.depth * factor, metric=True)


class StreamHook:
    """Something that watches a stream or changes its output; the base does nothing.

    All methods run in the inference thread, in the frames' order.
    """

    def before_frame(self, frame: StreamFrame) -> str | None:
        """A reason to start the stream anew with this frame, or None. Only causal knowledge."""
        return None

    def started(self, reason: str | None) -> None:
        """The stream starts with the coming frame; reason None is the very first one."""

    def after_prediction(self, frame: StreamFrame, geometry: Geometry) -> Geometry:
        """What to publish instead of the geometry."""
        return geometry

    def adopt(self, frame: StreamFrame) -> tuple[StreamKey, DepthStream, int] | None:
        """A stream to go on with from this frame, its key and epoch, instead of the own one."""
        return None

    def report(self) -> dict[str, str]:
        """For diagnostics, any thread: name and value."""
        return {}

    def problems(self) -> list[str]:
        """For diagnostics, any thread: what a user should look at."""
        return []


@dataclass(frozen=True)
class TimeRules:
    """When stamps say that the past is over.

    tolerance: seconds that a stamp may go back. max_gap: seconds between frames; 0 is no limit.
    """

    tolerance: float = 0.2
    max_gap: float = 5.0

    def broken(self, before: float | None, now: float | None) -> str | None:
        """The reason to start anew, or None."""
        if before is None or now is None:
            return None
        if now < before - self.tolerance:
            return BACKWARDS
        return GAP if self.max_gap and now > before + self.max_gap else None


StreamMaker = Callable[[StreamKey], "DepthStream"]


def stream_maker(model: GeometryModel) -> StreamMaker:
    """The one way in which streams are made, live and offline."""
    from dyfn_core.stream.depth_stream import DepthStream

    def make(key: StreamKey) -> DepthStream:
        matrix = key.camera_matrix
        return DepthStream(
            model,
            camera_matrix=None if matrix is None else np.array(matrix).reshape(3, 3),
            stabilize=key.stabilize,
            num_tokens=key.num_tokens or None,
        )

    return make


@dataclass
class StreamSession:
    """Not for several threads at once: the inference thread owns it.

    resets: how often the stream started anew, by reason.
    """

    make: StreamMaker
    rules: TimeRules = field(default_factory=TimeRules)
    hooks: Sequence[StreamHook] = ()

    def __post_init__(self) -> None:
        self.resets: Counter[str] = Counter()
        self.stream: Any = None  # a DepthStream; its `memory` is all that it remembers
        self._key: StreamKey | None = None
        self._epoch = 0
        self._stamp: float | None = None
        self._failed = False
        self._reset: str | None = None

    def push(self, frame: StreamFrame) -> Geometry:
        """begin, the network, end. An exception goes to the caller; the stream starts anew."""
        stream = self.begin(frame)
        try:
            prediction = stream.push(frame.image, frame.stamp)
        except BaseException:
            self.fail()
            raise
        return self.end(frame, prediction)

    def begin(self, frame: StreamFrame) -> DepthStream:
        """The stream that this frame goes into, started anew if it must be."""
        for hook in self.hooks:
            if (adopted := hook.adopt(frame)) is not None:
                self._key, self.stream, self._epoch = adopted
                self._stamp, self._failed = None, False  # time went by, that is no gap
        first = self.stream is None and not self._failed
        reason = None if first else self._reason(frame)
        for hook in self.hooks:
            found = hook.before_frame(frame)
            reason = reason or (None if first else found)
        key = frame.key
        if self.stream is None or key != self._key:
            self.stream = self.make(key)
        elif reason:
            self.stream.reset(reason)
        if reason:
            self.resets[reason] += 1
        if first or reason:
            for hook in self.hooks:
                hook.started(reason)
        self._key, self._epoch, self._stamp = key, frame.epoch, frame.stamp
        self._failed, self._reset = False, reason
        return self.stream

    def _reason(self, frame: StreamFrame) -> str | None:
        if self._failed:
            return FAILED
        if frame.epoch != self._epoch:
            return frame.request
        assert self._key is not None
        return self.rules.broken(self._stamp, frame.stamp) or frame.key.difference(self._key)

    def end(self, frame: StreamFrame, prediction: Prediction) -> Geometry:
        """The prediction of a begun frame -> its geometry, as arrays."""
        geometry = _geometry(prediction, frame, self._reset)
        for hook in self.hooks:
            geometry = hook.after_prediction(frame, geometry)
        return geometry

    def fail(self) -> None:
        """The begun frame could not be worked on: the next one starts anew."""
        self.stream, self._failed = None, True


def _geometry(prediction: Prediction, frame: StreamFrame, reset: str | None) -> Geometry:
    depth = prediction.depth.cpu().numpy()
    valid = valid_depth(depth, prediction.mask.cpu().numpy())
    if frame.visible is not None:
        valid &= frame.visible
    matrix = frame.camera_matrix
    if matrix is None:
        matrix = pixel_intrinsics(
            prediction.intrinsics.cpu().numpy(), (depth.shape[0], depth.shape[1])
        )
    disparity = None if prediction.disparity is None else prediction.disparity.cpu().numpy()
    points = prediction.points.cpu().numpy()
    return Geometry(points, depth, valid, matrix, reset, disparity=disparity)
