"""The values that go in and come out: Frame, StreamState, Prediction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np
import torch
from torch import Tensor
from typing_extensions import TypeVar

from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.quantities import AFFINE_DEPTH as AFFINE_DEPTH
from dyfn_core.quantities import DEPTH as DEPTH
from dyfn_core.quantities import DISPARITY as DISPARITY


@dataclass(frozen=True)
class Frame:
    """One camera image on its way into a stream.

    Attributes:
        image: H x W x 3 uint8, RGB.
        stamp: Seconds; None when the source has no clock.
        camera_matrix: 3 x 3 float64 intrinsics in pixels; None when unknown.
        visible: H x W bool, False where the image shows nothing (the border of an undistorted
            image); None: everything is visible.
        frame_id: Name of the optical frame. Another name is another camera.
        pose: 4 x 4 float64, camera to world in metres, of the optical frame (x right, y down, z
            forward), by the robot's odometry; None when unknown. Used by metric_source "odometry".
        pose_variance: What the odometry says of its own errors: variance per axis of rotation
            (rad^2) and translation (m^2), accumulated along the way to this pose, so that the
            difference between two frames is that of the motion between them. None when unknown.
    """

    image: np.ndarray
    stamp: float | None = None
    camera_matrix: np.ndarray | None = None
    visible: np.ndarray | None = None
    frame_id: str = ""
    pose: np.ndarray | None = None
    pose_variance: tuple[float, float] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the image."""
        return self.image.shape[0], self.image.shape[1]


@dataclass(frozen=True)
class StreamState:
    """What the recurrence remembers between two frames; a value, never mutated.

    Attributes:
        hidden: Hidden state h_t. ConvGRU: B x C x h x w, GRU: B x C.
        ema_mean: B x C, only for the GRU variant, whose statistics are an exponential moving
            average; NaN in a row that has no history yet.
        ema_std: As ema_mean, for the standard deviation.
    """

    hidden: Tensor
    ema_mean: Tensor | None = None
    ema_std: Tensor | None = None

    @staticmethod
    def stack(states: Sequence[StreamState | None]) -> StreamState | None:
        """The state of a batch of streams.

        Args:
            states: One of each stream (B of 1). None, a stream at its first frame, becomes what
                it means: a zero hidden state and no history.

        Returns:
            The state of the batch, in the same order; None when all are None.

        Raises:
            ValueError: The shapes differ.
        """
        known = [state for state in states if state is not None]
        if not known:
            return None
        shapes = {tuple(state.hidden.shape[1:]) for state in known}
        if len(shapes) > 1:
            raise ValueError(f"states of different shapes make no batch: {sorted(shapes)}")
        fresh = known[0].without_history()
        rows = [fresh if state is None else state for state in states]
        return StreamState(
            torch.cat([row.hidden for row in rows]),
            _cat([row.ema_mean for row in rows]),
            _cat([row.ema_std for row in rows]),
        )

    def unbind(self) -> list[StreamState]:
        """The states of the streams of a batch.

        Returns:
            B states of one stream each; the inverse of `stack`.
        """

        def row(values: Tensor | None, index: int) -> Tensor | None:
            return None if values is None else values[index : index + 1]

        return [
            StreamState(self.hidden[i : i + 1], row(self.ema_mean, i), row(self.ema_std, i))
            for i in range(len(self.hidden))
        ]

    def to(self, device: torch.device | str) -> StreamState:
        """The same state on another device.

        Args:
            device: A torch device or its name.

        Returns:
            A state with tensors there.
        """
        return StreamState(
            self.hidden.to(device),
            None if self.ema_mean is None else self.ema_mean.to(device),
            None if self.ema_std is None else self.ema_std.to(device),
        )

    def without_history(self) -> StreamState:
        """What None means: the state of one stream before its first frame, of these shapes.

        Returns:
            A zero hidden state and NaN for the averages.
        """

        def blank(like: Tensor | None) -> Tensor | None:
            return None if like is None else torch.full_like(like[:1], float("nan"))

        return StreamState(
            torch.zeros_like(self.hidden[:1]), blank(self.ema_mean), blank(self.ema_std)
        )


def _cat(rows: Sequence[Tensor | None]) -> Tensor | None:
    known = [row for row in rows if row is not None]
    return torch.cat(known) if known else None


def _array(values: Tensor | np.ndarray) -> np.ndarray:
    return values.cpu().numpy() if isinstance(values, Tensor) else values


ArrayT = TypeVar("ArrayT", Tensor, np.ndarray, default=Tensor)


@dataclass(frozen=True)
class Prediction(Generic[ArrayT]):
    """Geometry of one image, or of a batch (every array then has a leading B).

    Models and DepthStream give tensors on the model's device; StreamSession gives numpy arrays,
    see `numpy`.

    Attributes:
        points: H x W x 3 float32, optical frame (x right, y down, z forward).
        depth: H x W float32, z of the points; +inf where the model predicts nothing.
        mask: H x W bool, True where the prediction is valid.
        intrinsics: 3 x 3 float32, normalised: pixel x = (u + 0.5) / W, y = (v + 0.5) / H.
            `camera_matrix` has them in pixels.
        state: Goes into the next call of the same stream; None for a model without DyFN.
        quantity: What the model predicts. "depth": depth is right up to one scale.
            "affine_depth": right up to scale and shift; the shift is taken for 0. "disparity":
            `disparity` is right up to scale and shift; depth is its inverse under the assumption
            that the shift is 0, so compare with truth by aligning `disparity` with 1 / z.
        disparity: H x W float32, >= 0, only for quantity "disparity".
        known_camera: 3 x 3 float64 in pixels, the camera matrix that was given; None when the
            intrinsics are an estimate.
        reset: Why the stream was reset with this frame; None when it went on, or was the first.
        metric: Whether points and depth are in metres; else they are right up to one scale.
        unit: depth / unit keeps one scale over the whole stream, also where metres begin or end.
        withheld: H x W bool, what `mask` leaves out only because its metres are not known; None
            when that is nothing.
        normal: H x W x 3 float32, unit normals of the surfaces in the optical frame, as the model
            says; 0 where the model predicts nothing. None for models without them, and in streams
            that were not asked for them.
        model_scale: Metres in one unit of a stream's depth by the model's own word for this frame,
            see metric_source "model"; None where it said nothing.
    """

    points: ArrayT
    depth: ArrayT
    mask: ArrayT
    intrinsics: ArrayT
    state: StreamState | None = None
    quantity: str = DEPTH
    disparity: ArrayT | None = None
    known_camera: np.ndarray | None = None
    reset: str | None = None
    metric: bool = False
    unit: float = 1.0
    withheld: ArrayT | None = None
    normal: ArrayT | None = None
    model_scale: float | None = None

    @property
    def camera_matrix(self) -> np.ndarray:
        """3 x 3 float64 in pixels (of one image): the given one, else the model's estimate."""
        if self.known_camera is not None:
            return self.known_camera
        size = (self.depth.shape[0], self.depth.shape[1])
        return pixel_intrinsics(_array(self.intrinsics), size)

    @property
    def valid(self) -> ArrayT:
        """H x W bool: the mask where depth is finite and in front of the camera."""
        return self.mask & (self.depth > 0) & (self.depth < math.inf)

    @property
    def aligned_quantity(self) -> tuple[ArrayT, ArrayT]:
        """What scores align with truth, H x W, and where it is valid, H x W bool.

        Depth in the stream's own unit, also where its metres are withheld; or disparity, which is
        valid also where its inverse is too far to be depth.
        """
        if self.disparity is not None:
            return self.disparity, abs(self.disparity) < math.inf
        known = self.mask if self.withheld is None else self.mask | self.withheld
        depth = self.depth if self.unit == 1.0 else self.depth / self.unit
        return depth, known & (depth > 0) & (depth < math.inf)

    @property
    def steady(self) -> bool:
        """Whether depth and mask are as `aligned_quantity` has them: one unit, nothing withheld."""
        return self.unit == 1.0 and self.withheld is None

    def numpy(self) -> Prediction[np.ndarray]:
        """The same with numpy arrays in place of tensors.

        Returns:
            A prediction on the CPU; the state keeps its tensors.
        """
        return Prediction(
            _array(self.points),
            _array(self.depth),
            _array(self.mask),
            _array(self.intrinsics),
            self.state,
            self.quantity,
            None if self.disparity is None else _array(self.disparity),
            self.known_camera,
            self.reset,
            self.metric,
            self.unit,
            None if self.withheld is None else _array(self.withheld),
            None if self.normal is None else _array(self.normal),
            self.model_scale,
        )

    def scaled(self, scale: float) -> Prediction[ArrayT]:
        """The same in metres.

        Args:
            scale: Metres in one unit of this prediction.

        Returns:
            A prediction with points and depth times `scale`, and `metric` True.
        """
        factor = np.float32(scale).item()
        return replace(self, points=self.points * factor, depth=self.depth * factor, metric=True)
