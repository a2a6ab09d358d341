"""StreamSession: one camera's frames in, geometry out, with everything that a stream can do."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from dyfn_core.prediction import AFFINE_DEPTH, DEPTH, DISPARITY, Frame, Prediction
from dyfn_core.stream.depth_stream import DepthStream, same_camera
from dyfn_core.stream.metric_stage import MetricStage
from dyfn_core.stream.model_stage import ModelStage
from dyfn_core.stream.motion_stage import MotionStage
from dyfn_core.stream.options import StreamOptions, options_of
from dyfn_core.stream.picture_stage import PictureStage
from dyfn_core.stream.resets import (
    FAILED,
    NEW_CAMERA,
    NEW_FRAME_ID,
    NEW_SETTINGS,
    REQUESTED,
)
from dyfn_core.stream.saving import Loaded, StateKeeper, StreamSettings
from dyfn_core.stream.scale_memory_stage import ScaleMemoryStage
from dyfn_core.stream.scale_stage import ScaleStage
from dyfn_core.stream.scene_cut_stage import Place, SceneCutStage
from dyfn_core.stream.stages import StreamStage

if TYPE_CHECKING:
    from dyfn_core.metric.references import Reference
    from dyfn_core.metric.scale import ScaleInForce
    from dyfn_core.models.base import GeometryModel


@dataclass(frozen=True)
class ResetRequest:
    """The resets that were asked for up to some moment: how many, and why the last one."""

    count: int = 0
    reason: str = REQUESTED


class StreamSession:
    """One camera over time: what the node, dyfn-replay and the benchmarks run.

    A frame passes, in this order: a state that was loaded takes the stream's place; the rules
    decide whether the stream must be reset (a failed frame, a request, another frame_id, stamps,
    image size, camera matrix, settings, then the stages: scene cuts); the network and DyFN; the
    stages again, in their order: pictures that show nothing, the memory of scale, metres, and what
    the caller adds.
    The first rule that applies gives the reason of a reset. A reset ends the memory of the stream
    and of its stages.

    One thread pushes frames and sets `options`. `add_reference`, `request_reset`, `save`, `load`,
    `report`, `problems` and `faults` may be called by others.

    Attributes:
        model: The network, shared by any number of sessions.
        stages: Scene cuts, unusable pictures, the memory of scale (option scale_memory), metric
            scale, and those that were given, in this order.
        resets: How often the stream was reset, by reason (see dyfn_core.stream.resets).
        last_reset: The last reset as a line of a log; "" before the first.
        stream: What holds the memory; None before the first frame and after a failed one.
        normals: Whether the predictions of the frames to come have normals, if the model does.

    Example:
        >>> from dyfn_core.models import load_model
        >>> options = StreamOptions(metric_source="fixed", metric_scale=2.5, num_tokens=24)
        >>> session = StreamSession(load_model("dyfn-mini"), options)
        >>> image = np.full((48, 64, 3), 128, np.uint8)
        >>> found = session.push(Frame(image, stamp=0.0))
        >>> found.depth.shape, found.metric, found.camera_matrix.shape
        ((48, 64), True, (3, 3))
        >>> session.push(Frame(image, stamp=60.0)).reset
        'gap between stamps'
    """

    def __init__(
        self,
        model: GeometryModel,
        options: StreamOptions | None = None,
        stages: Sequence[StreamStage] = (),
    ) -> None:
        """Start a session without frames.

        Args:
            model: The network.
            options: None for the defaults.
            stages: Of the caller's own; they come after those of the session.

        Raises:
            ValueError: An option that is not allowed, or metres that the model's output cannot
                have.
        """
        self.model = model
        self._options = options = options or StreamOptions()
        check_metres(model, options)
        stages_by_source: dict[str, type[ScaleStage]] = {
            MotionStage.source: MotionStage,
            ModelStage.source: ModelStage,
        }
        metric = stages_by_source.get(options.metric_source, MetricStage)
        self._metric = metric(lambda: self._options)
        cuts = SceneCutStage(
            lambda: self._options.scene_cut_threshold, lambda frame: self._place(frame)
        )
        self._pictures = PictureStage(lambda: self._options)
        memory = (ScaleMemoryStage(),) if options.scale_memory else ()
        self.stages: tuple[StreamStage, ...] = (
            cuts,
            self._pictures,
            *memory,
            self._metric,
            *stages,
        )
        self.resets: Counter[str] = Counter()
        self.last_reset = ""
        self._place: Place = _as_it_is
        self.stream: DepthStream | None = None
        self.normals = False
        self.asked = ResetRequest()
        self._keeper = StateKeeper(self.stages, model)
        self._done = ResetRequest()  # what was asked for before the last frame
        self._settings = self._settings_with("")
        self._failed = False
        self._loaded: tuple[ResetRequest, Loaded] | None = None  # for the frame after the request
        self._lock = threading.Lock()

    @property
    def options(self) -> StreamOptions:
        """The options in force."""
        return self._options

    @options.setter
    def options(self, options: StreamOptions) -> None:
        for name, described in options_of(StreamOptions).items():
            old, new = getattr(self._options, name), getattr(options, name)
            if old != new and not described.live:
                raise ValueError(f"{name} is {old!r} for the whole session, it cannot be {new!r}")
        self._options = options

    @property
    def scale(self) -> ScaleInForce:
        """What the depth of the last frame means."""
        return self._metric.scale

    @property
    def unused_references(self) -> Counter[str]:
        """How many measurements, or points of them, were not used, by reason."""
        return self._metric.unused

    @property
    def metres_per_unit(self) -> float | None:
        """Of the unit that the whole stream keeps; None before its metres are known, see
        Prediction.unit."""
        return self._metric.metres_per_unit

    @property
    def unusable_pictures(self) -> Counter[str]:
        """How many pictures gave no depth, by reason: a covered lens, a frozen camera."""
        return self._pictures.unusable

    # Any thread.

    def add_reference(self, stamp: float, reference: Reference) -> None:
        """A measurement for metric_source "reference".

        Args:
            stamp: Seconds, on the clock of the frames. The measurement is compared with the frame
                of the nearest stamp, within `reference_tolerance` of it: the one that is pushed
                next, or one of the last `reference_history` seconds.
            reference: A PointReference, DepthReference or ConeReference, in the optical frame.
        """
        self._metric.add_reference(stamp, reference)

    def request_reset(self, reason: str = REQUESTED) -> ResetRequest:
        """Reset the stream with the next frame.

        Args:
            reason: What `resets` counts it under.

        Returns:
            What to push frames with that come from now on. Frames that came before may still be
            pushed, with the value of `asked` from when they came: they see the old memory.
        """
        with self._lock:
            self.asked = ResetRequest(self.asked.count + 1, reason)
            return self.asked

    def request_calibration(self) -> str:
        """Measure the metric scale anew, in the same unit, from the next frame on.

        What is in force stays so until that has worked.

        Returns:
            A line that says what is awaited.

        Raises:
            ValueError: The source of metres measures nothing.
        """
        options = self._options
        if not self._metric.measures:
            raise ValueError(
                f"metric_source is {options.metric_source!r}, which measures nothing: there is no "
                "scale to calibrate"
            )
        self._metric.request_calibration()
        known = self.scale.map
        former = "" if known is None else f"; until then {known.scale:.4g} stays in force"
        return f"the scale is measured anew, by {options.metric_source}{former}"

    def save(self, path: str | None = None) -> str:
        """Write the state after the last frame to a file; an older file is kept when that fails.

        Args:
            path: None for the option state_file.

        Returns:
            A line that says what was saved.

        Raises:
            StateError: There is nothing to save, or the file cannot be written.
        """
        return self._keeper.save(self._options.state_file if path is None else path)

    def load(self, path: str | None = None) -> str:
        """Go on from a state file with the next frame that is pushed.

        Args:
            path: None for the option state_file.

        Returns:
            A line that says what was loaded.

        Raises:
            StateError: A file that cannot be read, is damaged, belongs to another model or to
                other options, or does not fit the camera. The session is then as it was.
        """
        path = self._options.state_file if path is None else path
        loaded = self._keeper.load(path, self._options)
        with self._lock:
            asked = ResetRequest(self.asked.count + 1)
            self._loaded = (asked, loaded)
            self.asked = asked
        return f"goes on after {loaded.saved.memory.frames} frames from {path}"

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the model, which a state file names; found on first use (seconds)."""
        return self._keeper.fingerprint

    def report(self) -> dict[str, str]:
        """What the stages know, and the model's fingerprint.

        Returns:
            Name -> value, for diagnostics.
        """
        found: dict[str, str] = {}
        for stage in self.stages:
            found.update(stage.report())
        return {**found, "model fingerprint": self.fingerprint[:12]}

    def problems(self) -> list[str]:
        """What a user should look at.

        Returns:
            One line a problem; empty when there is none.
        """
        return [problem for stage in self.stages for problem in stage.problems()]

    def faults(self) -> list[str]:
        """Why the last frame has no depth at all, though the stream runs.

        Returns:
            One line a fault; empty when there is none.
        """
        return [fault for stage in self.stages for fault in stage.faults()]

    # The thread that pushes frames.

    def push(
        self,
        frame: Frame | np.ndarray,
        stamp: float | None = None,
        *,
        camera_matrix: np.ndarray | None = None,
        pose: np.ndarray | None = None,
        asked: ResetRequest | None = None,
    ) -> Prediction[np.ndarray]:
        """The geometry of the next frame.

        Args:
            frame: The image, H x W x 3 uint8 RGB without lens distortion, with the three arguments
                that follow; or a Frame, which has them in it.
            stamp: Seconds; None when the source has no clock.
            camera_matrix: 3 x 3 intrinsics in pixels, used for this frame; a different one resets
                the stream. None when unknown.
            pose: T_world_camera by the robot's odometry, for metric_source "odometry": 4 x 4,
                camera to world, metres, of the optical frame (x right, y down, z forward). The
                world may be any that stands still. None when unknown.
            asked: What `asked` was when the frame came; None when it comes now.

        Returns:
            Arrays of the image's size. `metric` says whether they are in metres, `reset` whether
            and why the stream was reset with this frame.

        Raises:
            TypeError, ValueError: A bad image, stamp, camera matrix or pose. The stream resets with
                the next frame.
        """
        if not isinstance(frame, Frame):
            frame = Frame(frame, stamp, camera_matrix, pose=pose)
        elif stamp is not None or camera_matrix is not None or pose is not None:
            raise TypeError("stamp, camera_matrix and pose of a Frame are its own")
        try:
            stream = self.begin(frame, asked)
            return self.end(frame, stream.push(frame.image, frame.stamp))
        except BaseException:
            self.fail()
            raise

    def skip(self, frame: Frame) -> None:
        """Look at a frame that is not worked on, for want of time: it may show a scene cut.

        Pictures that are close in time tell a cut from a motion, those far apart do not. The next
        frame that is pushed then resets the stream.

        Args:
            frame: As for push; of a time between the last frame and the next.
        """
        for stage in self.stages:
            stage.skipped(frame)

    def begin(
        self, frame: Frame, asked: ResetRequest | None = None, place: Place | None = None
    ) -> DepthStream:
        """The half of push before the network, for callers that run several cameras in a batch.

        Args:
            frame: As for push. Its pose may still be unknown, if `end` gets it.
            asked: As for push.
            place: Gives the frame its pose; asked only when the reset depends on it, since the
                pose may have to be waited for. None: the frame has it, or has none.

        Returns:
            The stream that the frame goes into (see push_together), reset if it must be. `end`
            follows, or `fail`.
        """
        asked = self.asked if asked is None else asked
        self._adopt(asked)
        self._place = place or _as_it_is
        first = self.stream is None and not self._failed
        reason = None if first else self._reason(frame, asked)
        for stage in self.stages:
            with _forgotten_if_it_fails(stage):
                found = stage.before_frame(frame)
            reason = reason or (None if first else found)
        if self.stream is None or reason:
            self.stream = self._start(frame, reason)
        if reason:
            self.last_reset = self._told(frame, reason)
        self.stream.rules = self._options.time_rules
        self.stream.model_metres = self._options.metric_source == ModelStage.source
        self.stream.normals = self.normals
        self._done, self._settings = asked, self._settings_with(frame.frame_id)
        self._failed = False
        return self.stream

    def end(self, frame: Frame, prediction: Prediction) -> Prediction[np.ndarray]:
        """The half of push after the network.

        Args:
            frame: The frame that was begun.
            prediction: What its stream gave, of one image.

        Returns:
            As push.
        """
        found = prediction.numpy()
        valid = found.valid if frame.visible is None else found.valid & frame.visible
        found = replace(found, mask=valid, known_camera=frame.camera_matrix)
        for stage in self.stages:
            with _forgotten_if_it_fails(stage):
                found = stage.after_prediction(frame, found)
        assert self.stream is not None
        self._keeper.remember(self._settings, self.stream)
        return found

    def fail(self) -> None:
        """The begun frame could not be worked on: the stream resets with the next one."""
        self.stream, self._failed = None, True

    def _adopt(self, asked: ResetRequest) -> None:
        """Let a loaded state take the stream's place, unless the frame came before it."""
        with self._lock:
            if self._loaded is None or asked.count < self._loaded[0].count:
                return
            (self._done, loaded), self._loaded = self._loaded, None
        self.stream, self._failed = loaded.stream, False
        self.stream.resets = self.resets
        self._settings = loaded.settings
        for stage in self.stages:
            saved = stage.saved_as
            stage.restore(getattr(loaded.saved, saved) if saved else None)

    def _reason(self, frame: Frame, asked: ResetRequest) -> str | None:
        """The first rule, those of the stages apart, by which this frame resets the stream."""
        if self.stream is None:
            return FAILED
        if asked.count != self._done.count:
            return asked.reason
        memory, now = self.stream.memory, self._settings_with(frame.frame_id)
        if reason := memory.reason_to_reset(self._options.time_rules, frame.size, frame.stamp):
            return reason
        if frame.frame_id != self._settings.frame_id:
            return NEW_FRAME_ID
        if not same_camera(self.stream.camera_matrix, frame.camera_matrix):
            return NEW_CAMERA
        return None if now == self._settings else NEW_SETTINGS

    def _told(self, frame: Frame, reason: str) -> str:
        """A reset as a line of a log: when, why, and what the stage that asked for it measured."""
        when = "" if frame.stamp is None else f"at {frame.stamp:.3f} s: "
        for stage in self.stages:
            if measured := stage.report().get(reason):
                reason = f"{reason} ({measured})"
        return f"{when}{reason}"

    def _settings_with(self, frame_id: str) -> StreamSettings:
        return StreamSettings(self._options.stabilize, self._options.num_tokens, frame_id)

    def _start(self, frame: Frame, reason: str | None) -> DepthStream:
        """A stream without memory; the reason of the reset is counted."""
        settings = self._settings_with(frame.frame_id)
        stream = settings.stream(self.model, frame.camera_matrix)
        stream.resets = self.resets
        if reason:
            stream.reset(reason)
        for stage in self.stages:
            stage.started(reason)
        return stream


def check_metres(model: GeometryModel, options: StreamOptions) -> None:
    """Raises ValueError when metric_source or scale_memory is not for what the model predicts."""
    source = options.metric_source
    if source == ModelStage.source and not model.knows_metres:
        raise ValueError(
            f"metric_source is {source!r}, but the model knows no metres; expected a metric one "
            "(MoGe v2, Depth Anything 3 metric) or another source"
        )
    if model.quantity == DISPARITY and source != "none":
        raise ValueError(
            f"metric_source is {source!r}, but the model predicts disparity, "
            "whose unknown shift no metric scale undoes; expected 'none'"
        )
    with_shift = source == "reference" and options.calibration_fit == "scale_shift"
    if model.quantity == AFFINE_DEPTH and source != "none" and not with_shift:
        raise ValueError(
            f"metric_source is {source!r}, but the model's depth has an unknown shift, which a "
            "scale alone does not undo; expected 'none', or 'reference' with calibration_fit "
            "'scale_shift'"
        )
    if options.scale_memory and model.quantity != DEPTH:
        raise ValueError(
            f"scale_memory is True, but the model predicts {model.quantity}, whose unknown shift "
            "no factor undoes; expected False"
        )


@contextmanager
def _forgotten_if_it_fails(stage: StreamStage) -> Iterator[None]:
    """What a stage cannot work with, such as a damaged state, must not fail every frame."""
    try:
        yield
    except Exception:
        stage.restore(None)
        raise


def _as_it_is(frame: Frame) -> Frame:
    return frame
