"""The stage that finds metres, and a steadier depth, from the camera's own motion."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dyfn_core.metric.fit import MetricMap
from dyfn_core.metric.motion_scale import (
    MotionFrame,
    MotionScale,
    MotionScaleOptions,
    MotionScaleState,
    step,
)
from dyfn_core.metric.plausible import IMPLAUSIBLE, implausible, middle_depth
from dyfn_core.metric.references import Reference
from dyfn_core.metric.scale import ScaleInForce
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.scale_stage import ScaleStage

_LATELY = 3.0  # seconds that a problem of the odometry is a user's business for


class MotionStage(ScaleStage):
    """Depth in one locked unit, and its metres, by metric_source "odometry".

    Each frame's scale, and the smooth field that mends its shape, come from points that are
    triangulated with the frames' poses (dyfn_core.metric.motion_scale). The unit is locked at the
    first measurement and the output goes on without a jump; metres follow when the odometry has
    agreed with the pictures for some seconds. Until then `until_metric` says what goes out.
    """

    saved_as = "motion"
    source = called = "odometry"

    def __init__(self, options: Callable[[], StreamOptions]) -> None:
        """options: See ScaleStage."""
        super().__init__(options)
        self._how = MotionScaleOptions()
        if not options().scale_field:
            self._how = replace(self._how, field=None)
        self._state = MotionScaleState()
        self._last_problem: tuple[float, str] = (-math.inf, "")
        self._kept = ""
        self.scale = ScaleInForce(self.source, problem="no measurement yet")
        self._unused: Counter[str] = Counter()

    @property
    def metres_per_unit(self) -> float | None:
        """Metres in the locked unit; None before it is locked."""
        unit = self._state.unit
        return None if unit is None else math.exp(unit)

    @property
    def unused(self) -> Counter[str]:
        """See ScaleStage: frames that gave no points, by what was wrong with the odometry."""
        return self._unused

    @property
    def state(self) -> MotionScaleState:
        """See StreamStage."""
        return self._state

    def restore(self, state: MotionScaleState | None) -> None:
        """See StreamStage."""
        self._state, self._kept = state or MotionScaleState(), ""

    def add_reference(self, stamp: float, reference: Reference) -> None:
        """A measurement of another kind: counted, not used."""
        del stamp, reference
        self._unused[f"a reference, but metric_source is {self.source}"] += 1

    def started(self, reason: str | None) -> None:
        """A new stream has a unit of its own; what is known of the metres may be kept."""
        self._state = self._state.restarted(self._how) if self._keeps else MotionScaleState()
        self._last_problem = (-math.inf, "")
        known = self._state.scale is not None
        self._kept = f"kept from before a reset ({reason})" if known and reason else ""

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        """See StreamStage.

        Raises:
            ValueError: The frame has no stamp, or its pose another shape than 4 x 4.
        """
        if frame.stamp is None:
            raise ValueError(f"metric_source {self.source!r} needs the frame's stamp, got None")
        if frame.camera_matrix is None:
            self.scale = replace(self.scale, map=None, problem="the camera matrix is unknown")
            self._unused[self.scale.problem] += 1
            return self._without_metres(prediction)
        if self._anew:
            self._anew = False
            self._state = self._state.less_certain(self._how)
        self._state, found = step(self._state, self._frame(frame, prediction), self._how)
        if found.measured is not None:
            self._kept = ""
        self.scale = self._described(frame.stamp, found)
        if found.points.problem:
            self._unused[_kind(found.points.problem)] += 1
        factor = found.factor
        steady = replace(
            prediction,
            depth=prediction.depth * factor,
            points=prediction.points * factor[..., None],
        )
        if found.metric is None:
            return self._without_metres(steady)
        metres = found.metric * middle_depth(steady.depth, steady.valid)
        if problem := implausible(found.metric, metres):
            self.scale = ScaleInForce(self.source, problem=problem)
            self._unused[IMPLAUSIBLE] += 1
            return self._without_metres(steady)
        return replace(steady.scaled(found.metric), unit=np.float32(found.metric).item())

    def _frame(self, frame: Frame, prediction: Prediction[np.ndarray]) -> MotionFrame:
        assert frame.stamp is not None and frame.camera_matrix is not None
        return MotionFrame(
            frame.image,
            frame.stamp,
            frame.camera_matrix,
            frame.pose,
            prediction.depth,
            prediction.valid,
            frame.pose_variance,
            frame.visible,
        )

    def _described(self, stamp: float, found: MotionScale) -> ScaleInForce:
        """What a user may know of the scale, and of the odometry."""
        problem = found.problem
        if found.points.problem:
            self._last_problem = (stamp, found.points.problem)
        elif not problem and stamp - self._last_problem[0] < _LATELY:
            problem = self._last_problem[1]
        if found.metric is None:
            return ScaleInForce(self.source, problem=problem or "no measurement yet")
        return ScaleInForce(
            self.source,
            MetricMap(found.metric * math.exp(found.log_scale)),
            spread=found.sigma,
            age=self._state.measured,
            points=len(found.points.ids),
            disagrees=bool(problem),
            problem=problem or self._kept,
            kept=bool(self._kept),
        )


def _kind(problem: str) -> str:
    """A problem without its numbers, for counting."""
    return problem.split(":")[0]
