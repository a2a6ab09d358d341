"""Depth that is right up to a scale, made steady and metric by the camera's own motion.

One pure step per frame: tracks are triangulated with the odometry's poses (metric.motion), points
of the last seconds are added (metric.point_memory), the frame's log scale is measured and filtered
(metric.scale_filter), and a smooth field takes up what one scale leaves wrong (metric.scale_field).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from dyfn_core.metric.motion import (
    MotionOptions,
    MotionPoints,
    MotionState,
    ScaleMeasurement,
    log_ratios,
    measure_scale,
    observe,
    surface_doubt,
)
from dyfn_core.metric.point_memory import (
    MemoryOptions,
    PointMemory,
    chosen,
    recall,
    remember,
    unhidden,
)
from dyfn_core.metric.scale_field import FieldOptions, scale_field
from dyfn_core.metric.scale_filter import (
    FilterOptions,
    FilterState,
    predict,
    restarted,
    update,
)
from dyfn_core.threads import one_blas_thread

_DOUBT = 2.5  # factor on a point's sigma: points of one frame err alike
_SHAPE = 0.11  # standard deviation of log depth that the field leaves to the prediction


@dataclass(frozen=True)
class MotionScaleOptions:
    """How the scale is found.

    Attributes:
        motion: triangulation and measurement.
        memory: of the points of earlier frames.
        scale: the filter over time.
        field: None leaves the shape of the prediction alone.
        field_sigma: largest standard deviation of log depth of a point of the field.
        field_sigma_pixels: the same for the part from the noise of the pixels.
        doubt_seconds: time constant of the share of contradicted frames.
        doubt: share of recent frames in which the odometry contradicts the pictures beyond which
            no metres are given. With the defaults an odometry has to agree for 3.5 s first.
        shape_doubt: the same share beyond which the depth is the prediction's own, and no
            remembered points are used. Between the two, scale and field fade.
    """

    motion: MotionOptions = field(default_factory=MotionOptions)
    memory: MemoryOptions = field(default_factory=MemoryOptions)
    scale: FilterOptions = field(default_factory=FilterOptions)
    field: FieldOptions | None = field(default_factory=FieldOptions)
    field_sigma: float = 0.5
    field_sigma_pixels: float = 0.2
    doubt_seconds: float = 5.0
    doubt: float = 0.25
    shape_doubt: float = 0.4


@dataclass(frozen=True)
class MotionFrame:
    """One frame of a stream.

    Attributes:
        image: H x W x 3 uint8 RGB, without lens distortion.
        stamp: seconds.
        camera_matrix: 3 x 3, pixels.
        pose: 4 x 4, camera to world, optical axes (x right, y down, z forward), metres; None when
            unknown.
        depth: H x W, predicted, right up to the stream's scale.
        valid: H x W bool, where there is a prediction.
        pose_variance: rotation (rad^2) and translation (m^2) per axis, accumulated along the way
            to the pose; None when unknown.
        visible: H x W bool, where the image shows something; None: everywhere.
        points: of another system, such as a visual-inertial odometry. Nothing is then tracked or
            remembered, and the pose is not used; None: tracked and triangulated here.
    """

    image: np.ndarray
    stamp: float
    camera_matrix: np.ndarray
    pose: np.ndarray | None
    depth: np.ndarray
    valid: np.ndarray
    pose_variance: tuple[float, float] | None = None
    visible: np.ndarray | None = None
    points: MotionPoints | None = None


@dataclass(frozen=True)
class MotionScaleState:
    """All that is remembered between two frames; a value.

    Attributes:
        motion: tracks and views.
        memory: points of the last seconds.
        scale: None before the first measurement.
        unit: log(metres / unit) of the relative output, locked at the first measurement.
        contradicted: share of recent frames in which the odometry contradicts the pictures; half
            at the start, as nothing is known of it.
        stamp: of the last frame, seconds; None when the time since then is unknown.
        measured: seconds since the last measurement, at `stamp`; NaN before the first one.
    """

    motion: MotionState = field(default_factory=MotionState)
    memory: PointMemory = field(default_factory=PointMemory)
    scale: FilterState | None = None
    unit: float | None = None
    contradicted: float = 0.5
    stamp: float | None = None
    measured: float = math.nan

    def restarted(self, options: MotionScaleOptions) -> MotionScaleState:
        """What is known when the stream of predictions was reset: the scale, less certain.

        Tracks and points end; the unit stays. Stamps may go on at any time.
        """
        scale = self.less_certain(options).scale
        return MotionScaleState(
            scale=scale, unit=self.unit, contradicted=self.contradicted, measured=self.measured
        )

    def less_certain(self, options: MotionScaleOptions) -> MotionScaleState:
        """The scale counts for less, so that the next measurements decide; all else stays."""
        if self.scale is None:
            return self
        return replace(self, scale=restarted(self.scale, options.scale))


@dataclass(frozen=True)
class MotionScale:
    """What a frame's depth is to be multiplied with.

    A frame whose odometry contradicts the pictures has no points of its own; those remembered
    from the seconds before still count.

    Attributes:
        log_scale: of the frame in the locked unit; 0 before and at the first measurement, and
            while the odometry contradicts most pictures.
        field: H x W float32, to be added to log_scale.
        metric: metres in the locked unit; None before the first measurement, and while the
            odometry has agreed with too few of the recent pictures.
        sigma: standard deviation of the frame's log scale in metres; NaN before the first
            measurement.
        points: that this frame rests on, remembered ones among them.
        measured: the measurement of this frame, None without one.
        problem: what is wrong with the odometry; empty when nothing is.
    """

    log_scale: float
    field: np.ndarray
    metric: float | None
    sigma: float
    points: MotionPoints
    measured: ScaleMeasurement | None
    problem: str

    @property
    def factor(self) -> np.ndarray:
        """H x W float32: units of the locked one in a unit of the prediction."""
        return np.asarray(np.exp(self.field + np.float32(self.log_scale)))

    def relative(self, depth: np.ndarray) -> np.ndarray:
        """H x W float32: predicted depth in the locked unit."""
        return np.asarray(depth * self.factor, np.float32)

    def metres(self, depth: np.ndarray) -> np.ndarray | None:
        """H x W float32: predicted depth in metres; None while `metric` is."""
        return None if self.metric is None else self.relative(depth) * np.float32(self.metric)


def step(
    state: MotionScaleState, frame: MotionFrame, options: MotionScaleOptions
) -> tuple[MotionScaleState, MotionScale]:
    """Take the next frame of a stream, on one thread of numpy's.

    Args:
        state: after the frame before, MotionScaleState() for the first; it is not changed.
        frame: the next one.
        options: the same for all frames of a stream.

    Returns:
        The state after this frame, and its scale.

    Raises:
        ValueError: arrays of the frame do not fit together, the camera matrix is no pinhole
            camera's, the pose is not 4 x 4, or the stamp is not finite.
    """
    _check(frame)
    with one_blas_thread():
        return _step(state, frame, options)


def _step(
    state: MotionScaleState, frame: MotionFrame, options: MotionScaleOptions
) -> tuple[MotionScaleState, MotionScale]:
    motion, points = _seen(state.motion, frame, options)
    elapsed = 0.0 if state.stamp is None else max(frame.stamp - state.stamp, 0.0)
    state = replace(_doubted(state, points, elapsed, options), motion=motion, stamp=frame.stamp)
    seen = len(points.ids)
    state, points = _remembered(state, points, frame, options)
    ratios = log_ratios(points, frame.depth, frame.valid)
    if state.scale is not None:
        kept = unhidden(ratios - state.scale.log_scale, seen, options.memory)
        points, ratios = chosen(points, kept), ratios[kept]
    doubt = surface_doubt(points.pixels, frame.depth, frame.valid)
    points = replace(points, sigma=np.hypot(points.sigma, doubt))
    measured = measure_scale(points, ratios, frame.depth.shape, options.motion)
    scale = _filtered(state.scale, measured, frame.stamp, options.scale)
    unit = scale.log_scale if state.unit is None and scale is not None else state.unit
    age = state.measured + elapsed if measured is None else 0.0
    state = replace(state, scale=scale, unit=unit, measured=age)
    if scale is None or unit is None:
        nothing = np.zeros(frame.depth.shape, np.float32)
        return state, MotionScale(0.0, nothing, None, math.nan, points, None, points.problem)
    share = _believed(state, options)
    found = MotionScale(
        log_scale=share * (scale.log_scale - unit),
        field=np.float32(share) * _field(state, points, ratios - scale.log_scale, frame, options),
        metric=math.exp(unit) if state.contradicted <= options.doubt else None,
        sigma=scale.sigma,
        points=points,
        measured=measured,
        problem=points.problem or _doubt_problem(state, options),
    )
    return state, found


def _seen(
    state: MotionState, frame: MotionFrame, options: MotionScaleOptions
) -> tuple[MotionState, MotionPoints]:
    """The frame's own points, given or triangulated."""
    if frame.points is not None:
        return replace(state, posed=False), frame.points
    return observe(
        state,
        frame.image,
        frame.camera_matrix,
        frame.pose,
        options.motion,
        frame.pose_variance,
        frame.visible,
    )


def _check(frame: MotionFrame) -> None:
    size = frame.image.shape[:2]
    if frame.image.shape != (*size, 3) or frame.image.dtype != np.uint8:
        raise ValueError(
            f"image must be H x W x 3 uint8, got {frame.image.shape} {frame.image.dtype}"
        )
    for name, array in (("depth", frame.depth), ("valid", frame.valid)):
        if array.shape != size:
            raise ValueError(f"{name} must have the image's size {size}, got {array.shape}")
    if not math.isfinite(frame.stamp):
        raise ValueError(f"stamp must be finite, got {frame.stamp}")


def _doubted(
    state: MotionScaleState, points: MotionPoints, elapsed: float, options: MotionScaleOptions
) -> MotionScaleState:
    """How often the odometry contradicts the pictures; frames that cannot tell do not count."""
    share = state.contradicted
    if math.isfinite(points.rms):
        keep = math.exp(-elapsed / options.doubt_seconds)
        share = keep * share + (1 - keep) * bool(points.problem)
    return replace(state, contradicted=share)


def _believed(state: MotionScaleState, options: MotionScaleOptions) -> float:
    """Share of scale and field that is applied: 1 where metres may be given, 0 beyond shape_doubt.

    It follows the share of contradicted frames, so the output does not jump.
    """
    if state.contradicted <= options.doubt:
        return 1.0
    room = options.shape_doubt - options.doubt
    return max(options.shape_doubt - state.contradicted, 0.0) / room if room > 0 else 0.0


def _doubt_problem(state: MotionScaleState, options: MotionScaleOptions) -> str:
    if state.contradicted <= options.doubt:
        return ""
    agreed, needed = (f"{100 * (1 - share):.0f}%" for share in (state.contradicted, options.doubt))
    return f"agrees with the pictures in {agreed} of the last frames, {needed} needed: no metres"


def _remembered(
    state: MotionScaleState, points: MotionPoints, frame: MotionFrame, options: MotionScaleOptions
) -> tuple[MotionScaleState, MotionPoints]:
    """The frame's points with the remembered ones, which tide over a few contradicted frames."""
    if not state.motion.posed:
        return state, points
    if points.rms > options.motion.lost_rms:
        return replace(state, memory=PointMemory()), points
    camera, pose, stamp = frame.camera_matrix, frame.pose, frame.stamp
    assert pose is not None
    size = (frame.depth.shape[0], frame.depth.shape[1])
    memory = remember(state.memory, points, camera, pose, stamp, options.memory)
    if state.contradicted <= options.shape_doubt:
        points = recall(state.memory, points, camera, pose, stamp, size, options.memory)
    return replace(state, memory=memory), points


def _filtered(
    state: FilterState | None,
    measured: ScaleMeasurement | None,
    stamp: float,
    options: FilterOptions,
) -> FilterState | None:
    if measured is not None:
        return update(state, stamp, measured.log_scale, measured.variance, options)
    return None if state is None else predict(state, stamp, options)


def _field(
    state: MotionScaleState,
    points: MotionPoints,
    residuals: np.ndarray,
    frame: MotionFrame,
    options: MotionScaleOptions,
) -> np.ndarray:
    """H x W float32; 0 where the field is switched off, not to be trusted or without points."""
    good = np.isfinite(residuals) & (points.sigma < options.field_sigma)
    good &= points.sigma_pixels < options.field_sigma_pixels
    if options.field is None or not _believed(state, options) or good.sum() < options.motion.fewest:
        return np.zeros(frame.depth.shape, np.float32)
    sigma, depth = points.sigma[good], np.where(frame.valid, frame.depth, np.nan)
    noise, misfit = np.hypot(_DOUBT * sigma, _SHAPE), np.hypot(sigma, _SHAPE)
    return scale_field(points.pixels[good], residuals[good], noise, depth, options.field, misfit)
