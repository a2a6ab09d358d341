"""One camera's frames through a DepthStream that is made anew when what it depends on changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dyfn_ros.messages import valid_depth

if TYPE_CHECKING:
    from dyfn_core.models.base import GeometryModel
    from dyfn_core.prediction import Prediction
    from dyfn_core.stream import DepthStream


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


@dataclass(frozen=True)
class Geometry:
    """Arrays of one frame, at its resolution.

    points: H x W x 3 float32. depth: H x W float32. valid: H x W bool.
    camera_matrix: 3 x 3 float64, pixels: the given one, else the model's estimate.
    """

    points: np.ndarray
    depth: np.ndarray
    valid: np.ndarray
    camera_matrix: np.ndarray


StreamMaker = Callable[[StreamKey], "DepthStream"]


def stream_maker(model: GeometryModel) -> StreamMaker:
    """The one way in which streams are made, live and offline."""
    from dyfn_core.stream import DepthStream

    def make(key: StreamKey) -> DepthStream:
        matrix = key.camera_matrix
        return DepthStream(
            model,
            camera_matrix=None if matrix is None else np.array(matrix).reshape(3, 3),
            stabilize=key.stabilize,
            num_tokens=key.num_tokens or None,
        )

    return make


class CameraStream:
    """Not for several threads at once: the inference thread owns it."""

    def __init__(self, make: StreamMaker) -> None:
        self._make = make
        self._key: StreamKey | None = None
        self._epoch = 0
        self._stream: Any = None

    def push(
        self,
        image: np.ndarray,
        camera_matrix: np.ndarray | None,
        *,
        stamp: float | None = None,
        epoch: int = 0,
        stabilize: bool = True,
        num_tokens: int = 0,
    ) -> Geometry:
        """image: H x W x 3 uint8 RGB. camera_matrix: 3 x 3 pixels or None.

        epoch: the number of resets before the frame; the stream starts anew when it changes, and
        also after an exception (which goes to the caller).
        """
        matrix = None if camera_matrix is None else tuple(camera_matrix.reshape(-1).tolist())
        key = StreamKey(image.shape[:2], matrix, stabilize, num_tokens)
        if self._stream is None or key != self._key:
            self._stream = self._make(key)
        elif epoch != self._epoch:
            self._stream.reset()
        self._key, self._epoch = key, epoch
        try:
            prediction = self._stream.push(image, stamp)
        except BaseException:
            self._stream = None
            raise
        return _geometry(prediction, camera_matrix)


def _geometry(prediction: Prediction, camera_matrix: np.ndarray | None) -> Geometry:
    depth = prediction.depth.cpu().numpy()
    mask = prediction.mask.cpu().numpy()
    if camera_matrix is None:
        camera_matrix = pixel_matrix(prediction.intrinsics.cpu().numpy(), *depth.shape)
    points = prediction.points.cpu().numpy()
    return Geometry(points, depth, valid_depth(depth, mask), camera_matrix)


def pixel_matrix(intrinsics: np.ndarray, height: int, width: int) -> np.ndarray:
    """Normalised intrinsics (x = (u + 0.5) / W) -> 3 x 3 float64 in pixels."""
    scale = np.array([[width], [height], [1.0]])
    matrix = np.asarray(intrinsics, np.float64) * scale
    matrix[:2, 2] -= 0.5
    return matrix
