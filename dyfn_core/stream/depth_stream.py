"""DepthStream: one camera over time, frame by frame, causally."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyfn_core.geometry.camera import (
    FocalShift,
    check_camera_matrix,
    focal_from_fov,
    intrinsics_from_focal,
    normalize_intrinsics,
    sample,
    sampled_uv,
    solve_focal_shift,
)
from dyfn_core.models.base import (
    NOMINAL_FOV,
    Affine,
    AffineDepth,
    AffineDisparity,
    AffinePoints,
    GeometryModel,
    assemble,
    first_of_batch,
    from_depth,
    from_disparity,
    image_to_batch,
    median_disparity,
    metric_scale,
    scale_ratio,
)
from dyfn_core.prediction import Prediction, StreamState
from dyfn_core.stream.resets import NEW_CAMERA, NEW_SIZE, REQUESTED, TimeRules

logger = logging.getLogger(__name__)

SHIFT_MODES = ("filtered", "held", "per_frame")
# A stabilized stream's metres by the model's own word cost a second pass of the decoder: of so many
# frames after a reset, and of every so-manieth then.
MEASURED_FIRST, MEASURED_EVERY = 10, 10


@dataclass(frozen=True)
class MeanState:
    """What a RobustMean remembers. spread: mean absolute innovation. count: measurements seen."""

    value: float
    spread: float = 0.0
    count: int = 1


@dataclass(frozen=True)
class RobustMean:
    """A recursive mean that settles, then follows slowly, and that one bad frame cannot move far.

    gain: smallest weight of a new measurement; until 1/n falls below it this is the plain mean
        of all measurements. 0 never follows.
    clip: an innovation beyond clip times the usual one counts as just that much.
    """

    gain: float = 0.02
    clip: float = 3.0

    def update(self, track: MeanState | None, measured: float) -> MeanState:
        """The track after one more measurement; None starts one."""
        if track is None:
            return MeanState(measured)
        count = track.count + 1
        weight = max(1 / count, self.gain)
        innovation = measured - track.value
        limit = self.clip * track.spread if count > 3 else math.inf
        step = min(max(innovation, -limit), limit)
        # The spread may grow faster than the value moves, so that a real change gets through.
        spread = track.spread + weight * (min(abs(innovation), 2 * limit) - track.spread)
        return MeanState(track.value + weight * step, spread, count)


@dataclass(frozen=True)
class StreamMemory:
    """All that a stream remembers between two frames: plain values and tensors.

    frames: since the last reset. image_size: (H, W). stamp: of the last frame, seconds.
    state: DyFN's. focal: of log(focal / half the diagonal), for an unknown camera.
    shift: of the z-shift, in the unit of the point map. unit: for a disparity model, the median
    disparity of the stream's first frame, which is depth 1 for all that follow.
    """

    frames: int = 0
    image_size: tuple[int, int] | None = None
    stamp: float | None = None
    state: StreamState | None = None
    focal: MeanState | None = None
    shift: MeanState | None = None
    unit: float | None = None

    def reason_to_reset(
        self, rules: TimeRules, size: tuple[int, int], stamp: float | None
    ) -> str | None:
        """Why a frame of this size (H, W) and stamp cannot follow the last one; None if it can."""
        if broken := rules.broken(self.stamp, stamp):
            return broken
        return None if self.image_size in (None, size) else NEW_SIZE

    def after(
        self, size: tuple[int, int], stamp: float | None, state: StreamState | None
    ) -> StreamMemory:
        """The memory after one more frame, of size (H, W); the filters are as they were."""
        return replace(self, frames=self.frames + 1, image_size=size, stamp=stamp, state=state)


def same_camera(one: np.ndarray | None, other: np.ndarray | None) -> bool:
    """Whether two camera matrices, None when unknown, are equal."""
    if one is None or other is None:
        return one is other
    return bool(np.array_equal(one, other))


class DepthStream:
    """Frames of one camera in, geometry that keeps its scale out.

    Causal and deterministic: a frame's output depends on the frames since the last reset only,
    and the same frames after a reset give the same bytes. The stream resets by itself when the
    stamps break its time rules, or when the size of the images or the camera matrix changes;
    StreamSession does that too, and adds scene cuts, metres and saved states.

    A known camera matrix fixes the focal and the principal point. An unknown camera's focal is a
    robust running mean. The shift is one number per stream as far as DyFN keeps the latent's
    statistics in place, so it is averaged over time; without DyFN every frame has its own.

    A model of disparity knows neither camera nor offset: depth is the inverse of its disparity in
    units of the first frame's median, an unknown camera is taken for one of NOMINAL_FOV, and
    every prediction says quantity "disparity". Depth Anything 3 gives depth without a camera: its
    depth is the stream's, and an unknown camera is taken for one of NOMINAL_FOV.

    The depth of models that know metres is relative here, in one unit for the stream; the
    prediction's `model_scale` has what the model says of the metres.

    Attributes:
        normals: Whether predictions have normals, of models that have them.
        model_metres: Whether to ask a stabilized model for its metres, which costs a second pass
            of the decoder in some frames; one without DyFN says them anyway.
        rules: When stamps say that a frame cannot follow the one before.
        resets: How often the stream was reset, by reason (see dyfn_core.stream.resets).
        memory: All that the stream remembers.

    Example:
        >>> from dyfn_core.models import load_model
        >>> stream = DepthStream(load_model("dyfn-mini"), num_tokens=24)
        >>> image = np.full((48, 64, 3), 128, np.uint8)
        >>> stream.push(image, stamp=0.0).depth.shape
        torch.Size([48, 64])
        >>> stream.push(image, stamp=60.0).reset
        'gap between stamps'
    """

    def __init__(
        self,
        model: GeometryModel,
        camera_matrix: np.ndarray | None = None,
        *,
        stabilize: bool = True,
        num_tokens: int | None = None,
        shift_mode: str | None = None,
        shift_filter: RobustMean | None = None,
        focal_filter: RobustMean | None = None,
        force_projection: bool = True,
        rules: TimeRules | None = None,
    ) -> None:
        """Start a stream.

        Args:
            model: The network, shared by any number of streams.
            camera_matrix: 3 x 3 in pixels, None when unknown.
            stabilize: False runs the base model on every frame by itself.
            num_tokens: Resolution inside the model; None for the model's default.
            shift_mode: "filtered" (running mean), "held" (the first frame's), "per_frame";
                None is "filtered" with DyFN and "per_frame" without.
            shift_filter: How the shift follows its measurements.
            focal_filter: How the focal of an unknown camera follows its measurements.
            force_projection: Points are the depth unprojected with the intrinsics.
            rules: For the stamps; None for the default TimeRules.

        Raises:
            ValueError: A bad camera matrix, shift_mode or num_tokens.
        """
        if shift_mode is not None and shift_mode not in SHIFT_MODES:
            raise ValueError(f"shift_mode {shift_mode!r} is unknown, expected one of {SHIFT_MODES}")
        if num_tokens is not None and num_tokens < 1:
            raise ValueError(f"num_tokens must be at least 1, got {num_tokens}")
        self.model = model
        self.stabilize = stabilize and model.stabilizer is not None
        self.num_tokens = num_tokens
        self.shift_mode = shift_mode or ("filtered" if self.stabilize else "per_frame")
        self.shift_filter = shift_filter or RobustMean()
        self.focal_filter = focal_filter or RobustMean()
        self.force_projection = force_projection
        self.rules = rules or TimeRules()
        self.normals = self.model_metres = False
        self.resets: Counter[str] = Counter()
        self.memory = StreamMemory()
        self._last_reset: str | None = None
        self._camera_matrix = None if camera_matrix is None else check_camera_matrix(camera_matrix)
        self._camera_size: tuple[int, int] | None = None

    @property
    def camera_matrix(self) -> np.ndarray | None:
        """3 x 3 float64, pixels; None when unknown. Setting another one resets the stream."""
        return None if self._camera_matrix is None else self._camera_matrix.copy()

    @camera_matrix.setter
    def camera_matrix(self, camera_matrix: np.ndarray | None) -> None:
        new = None if camera_matrix is None else check_camera_matrix(camera_matrix)
        if same_camera(new, self._camera_matrix):
            return
        self._camera_matrix, self._camera_size = new, None
        if self.memory.frames:
            self.reset(NEW_CAMERA)

    def reset(self, reason: str = REQUESTED) -> None:
        """Forget everything but the camera matrix; the next frame is a first frame.

        Args:
            reason: What `resets` counts it under.
        """
        self.resets[reason] += 1
        self.memory, self._last_reset = StreamMemory(), reason

    def push(self, image: np.ndarray | Tensor, stamp: float | None = None) -> Prediction:
        """The geometry of the next frame.

        Args:
            image: H x W x 3 uint8 RGB, or float 3 x H x W in 0..1.
            stamp: Seconds; None when unknown. A stamp that breaks the time rules resets the
                stream before this frame, as an image of another size does.

        Returns:
            Tensors of the image's size on the model's device; `reset` says whether, and why, the
            stream was reset with this frame.

        Raises:
            TypeError: Something that is no image.
            ValueError: An image of a wrong shape or range, or a stamp that is not finite. The
                stream is then as it was.
        """
        return push_together([self], [image], [stamp])[0]

    def _check(self, image: np.ndarray | Tensor, stamp: float | None) -> Tensor:
        """A frame -> 1 x 3 x H x W on the model's device; changes nothing."""
        if stamp is not None and not math.isfinite(stamp):
            raise ValueError(f"stamp must be a finite number of seconds, got {stamp}")
        batch, single = image_to_batch(image, self.model.device)
        if not single:
            raise ValueError(f"push takes one image at a time, got a batch of {len(batch)}")
        return batch

    def _make_room(self, size: tuple[int, int], stamp: float | None) -> None:
        """Reset if the frame cannot follow the last; a camera matrix is for one size only."""
        if self._camera_matrix is not None and self._camera_size not in (None, size):
            logger.warning(
                "the camera matrix is for images of %s, this one is %s: forgetting the matrix",
                self._camera_size,
                size,
            )
            self._camera_matrix = None
        if reason := self.memory.reason_to_reset(self.rules, size, stamp):
            self.reset(reason)
        self._camera_size = size

    def finish(
        self,
        affine: Affine,
        state: StreamState | None,
        stamp: float | None = None,
        own: Affine | None = None,
    ) -> Prediction:
        """The half of push after the network, for callers that run the network themselves.

        Such a caller owns DyFN's state, so only an image of another size resets the stream here.

        Args:
            affine: The frame's output, a batch of one.
            state: DyFN's state after the frame.
            stamp: Seconds.
            own: What the decoder makes of the latent that DyFN has not changed; None if that was
                not asked for, or DyFN does not run.

        Returns:
            As push.
        """
        if isinstance(affine, AffinePoints):
            prediction, memory = self._of_points(affine, state, stamp)
        else:
            prediction, memory = self._without_camera(affine, state, stamp)
        if not self.normals:
            prediction = replace(prediction, normal=None)
        scale = self._model_scale(affine, own, prediction)
        reset = None if self.memory.frames else self._last_reset
        self.memory = memory
        return replace(
            first_of_batch(prediction),
            known_camera=self.camera_matrix,
            reset=reset,
            model_scale=scale,
        )

    def _of_points(
        self, affine: AffinePoints, state: StreamState | None, stamp: float | None
    ) -> tuple[Prediction, StreamMemory]:
        valid = affine.mask > self.model.mask_threshold
        size = (valid.shape[-2], valid.shape[-1])
        self._make_room(size, None)
        samples, usable = sample(affine.points, valid)
        xyz, uv = samples[0][usable[0]], sampled_uv(*size)[usable[0]]
        memory = self.memory.after(size, stamp, state)
        if self._camera_matrix is not None:
            known = normalize_intrinsics(self._camera_matrix, size)
            intrinsics = torch.from_numpy(known)[None]
        else:
            memory = self._track_focal(memory, xyz, uv)
            focal = 1.0 if memory.focal is None else math.exp(memory.focal.value)
            intrinsics = intrinsics_from_focal(
                torch.tensor([focal], dtype=torch.float64), size[1] / size[0]
            )
        memory, shift = self._track_shift(memory, xyz, uv, intrinsics[0].numpy(), size)
        prediction = assemble(
            affine,
            valid,
            affine.points.new_tensor([shift]),
            intrinsics.to(affine.points),
            state,
            self.force_projection,
        )
        return prediction, memory

    def _without_camera(
        self, affine: AffineDepth | AffineDisparity, state: StreamState | None, stamp: float | None
    ) -> tuple[Prediction, StreamMemory]:
        size = (affine.values.shape[-2], affine.values.shape[-1])
        self._make_room(size, None)
        if self._camera_matrix is not None:
            intrinsics = torch.from_numpy(normalize_intrinsics(self._camera_matrix, size))[None]
        else:
            focal = focal_from_fov(NOMINAL_FOV, size[1] / size[0], 1)
            intrinsics = intrinsics_from_focal(focal, size[1] / size[0])
        intrinsics = intrinsics.to(affine.values)
        memory = self.memory.after(size, stamp, state)
        if isinstance(affine, AffineDepth):
            return from_depth(affine, self.model, intrinsics, state), memory
        disparity, unit = affine.disparity, memory.unit
        if unit is None:
            unit = float(median_disparity(disparity))
        prediction = from_disparity(disparity, disparity.new_tensor([unit]), intrinsics, state)
        return prediction, replace(memory, unit=unit)

    @property
    def measures(self) -> bool:
        """Whether the coming frame must be decoded without DyFN as well, for its metres."""
        if not (self.model_metres and self.stabilize and self._metres_can_be_known):
            return False
        frames = self.memory.frames
        return frames < MEASURED_FIRST or frames % MEASURED_EVERY == 0

    @property
    def _metres_can_be_known(self) -> bool:
        known = self.model.knows_metres
        return bool(known) and (known != "camera" or self._camera_matrix is not None)

    def _model_scale(
        self, affine: Affine, own: Affine | None, prediction: Prediction
    ) -> float | None:
        """Metres in one unit of this frame's depth, by the model; None where it says nothing."""
        if not self._metres_can_be_known or (self.stabilize and own is None):
            return None
        scale = metric_scale(affine, prediction.intrinsics)
        if scale is None:
            return None
        ratio = 1.0 if own is None else float(scale_ratio(self._own(own, prediction), prediction))
        found = float(scale) * ratio
        return found if math.isfinite(found) and found > 0 else None

    def _own(self, own: Affine, prediction: Prediction) -> Prediction:
        """What the model says of this frame by itself, with the stream's camera."""
        if isinstance(own, AffineDepth):
            return from_depth(own, self.model, prediction.intrinsics, None)
        assert isinstance(own, AffinePoints)  # disparity knows no metres
        valid = own.mask > self.model.mask_threshold
        size = (valid.shape[-2], valid.shape[-1])
        samples, usable = sample(own.points, valid)
        xyz, uv = samples[0][usable[0]], sampled_uv(*size)[usable[0]]
        found = _shift_of(xyz, uv, prediction.intrinsics[0].cpu().numpy(), size)
        shift = own.points.new_tensor([found.shift])
        return assemble(own, valid, shift, prediction.intrinsics, None)

    def _track_focal(self, memory: StreamMemory, xyz: np.ndarray, uv: np.ndarray) -> StreamMemory:
        found = solve_focal_shift(xyz, uv)
        if not found.solved:
            return memory
        return replace(memory, focal=self.focal_filter.update(memory.focal, math.log(found.focal)))

    def _track_shift(
        self,
        memory: StreamMemory,
        xyz: np.ndarray,
        uv: np.ndarray,
        intrinsics: np.ndarray,
        size: tuple[int, int],
    ) -> tuple[StreamMemory, float]:
        found = _shift_of(xyz, uv, intrinsics, size)
        if not found.solved:
            return memory, 0.0 if memory.shift is None else memory.shift.value
        if self.shift_mode == "per_frame":
            return memory, found.shift
        track = memory.shift
        if track is None or self.shift_mode == "filtered":
            track = self.shift_filter.update(track, found.shift)
        # A shift from other frames must not put this one's near parts behind the camera.
        floor = -0.98 * float(np.quantile(xyz[:, 2], 0.02))
        return replace(memory, shift=track), max(track.value, floor)


def _shift_of(
    xyz: np.ndarray, uv: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> FocalShift:
    """The z-shift of sampled points of an image of size (H, W) with a known camera."""
    # Stretched by the focals, x and y project with focal 1 whatever the pixels' aspect. The
    # network assumes a centred principal point, so its points are compared with centred rays.
    half = math.hypot(*size) / 2
    scale = [intrinsics[0, 0] * size[1] / half, intrinsics[1, 1] * size[0] / half, 1.0]
    return solve_focal_shift(xyz * scale, uv, focal=1.0)


def push_together(
    streams: Sequence[DepthStream],
    images: Sequence[np.ndarray | Tensor],
    stamps: Sequence[float | None] | None = None,
) -> list[Prediction]:
    """One frame of each stream in one batch; as push, but the network runs once.

    Args:
        streams: One a camera; they share model, num_tokens and stabilize.
        images: One a stream, of one size.
        stamps: Seconds, one a stream; None when unknown.

    Returns:
        One prediction a stream, in their order.

    Raises:
        ValueError: The streams or the images do not fit together; nothing has then been pushed.

    Example:
        >>> from dyfn_core.models import load_model
        >>> model = load_model("dyfn-mini")
        >>> left, right = (DepthStream(model, num_tokens=24) for _ in range(2))
        >>> images = [np.full((48, 64, 3), grey, np.uint8) for grey in (100, 150)]
        >>> [tuple(found.depth.shape) for found in push_together([left, right], images)]
        [(48, 64), (48, 64)]
    """
    stamps = [None] * len(streams) if stamps is None else stamps
    first = streams[0]
    for stream in streams:
        if (stream.model, stream.num_tokens, stream.stabilize) != (
            first.model,
            first.num_tokens,
            first.stabilize,
        ):
            raise ValueError("streams of one batch must share model, num_tokens and stabilize")
    if len({id(stream) for stream in streams}) < len(streams):
        raise ValueError("a stream cannot take two frames in one batch")
    with torch.inference_mode():
        frames = [
            stream._check(image, stamp)
            for stream, image, stamp in zip(streams, images, stamps, strict=True)
        ]
        if len({frame.shape for frame in frames}) > 1:
            raise ValueError(
                f"images of one batch must be of one size, got {[tuple(f.shape) for f in frames]}"
            )
        for stream, stamp in zip(streams, stamps, strict=True):
            stream._make_room((frames[0].shape[-2], frames[0].shape[-1]), stamp)
        state = StreamState.stack([stream.memory.state for stream in streams])
        model = first.model
        batch = frames[0] if len(frames) == 1 else torch.cat(frames)
        latent = model.encode(batch, first.num_tokens)
        changed, state = model.stabilized(latent, state, first.stabilize)
        normals = any(stream.normals for stream in streams)
        affine = model.decode_all(changed) if normals else model.decode(changed)
        own = [
            model.decode(latent.entry(i)) if stream.measures else None
            for i, stream in enumerate(streams)
        ]
        states: Sequence[StreamState | None]
        states = [None] * len(streams) if state is None else state.unbind()
        return [
            stream.finish(affine.entry(i), states[i], stamps[i], own[i])
            for i, stream in enumerate(streams)
        ]
