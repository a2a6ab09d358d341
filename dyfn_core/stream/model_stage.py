"""The stage that takes metres from the model's own word, by metric_source "model"."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dyfn_core.metric.fit import MetricMap
from dyfn_core.metric.references import Reference
from dyfn_core.metric.scale import ScaleInForce
from dyfn_core.metric.scale_filter import FilterOptions, FilterState, restarted, update
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.scale_stage import ScaleStage

# One frame's word is off by more than noise, and neighbouring frames alike: the stream's scale is
# the slow part of the filter.
FILTER = FilterOptions(deviation=0.15)
NOISE = 0.05  # standard deviation of the log scale that one frame says, besides the deviation


class ModelStage(ScaleStage):
    """Metres as the model says them: one number a frame, filtered over the stream.

    With DyFN the depth keeps one unit, and the metres in it are the slow state of a filter over the
    logarithm of what the model says. Without DyFN each frame has a unit of its own, and its own
    scale.
    """

    saved_as = "model_scale"
    source = called = "model"

    def __init__(self, options: Callable[[], StreamOptions]) -> None:
        """options: See ScaleStage."""
        super().__init__(options)
        self._state: FilterState | None = None
        self._kept = ""
        self._unused: Counter[str] = Counter()
        self.scale = ScaleInForce(self.source, problem="no measurement yet")

    @property
    def metres_per_unit(self) -> float | None:
        """See ScaleStage; without DyFN, 1 when depth is in metres."""
        if self._state is None:
            return 1.0 if self.scale.metric else None
        return math.exp(self._state.mean[0])

    @property
    def unused(self) -> Counter[str]:
        """See ScaleStage: frames without metres, and references."""
        return self._unused

    @property
    def state(self) -> FilterState | None:
        """See StreamStage."""
        return self._state

    def restore(self, state: FilterState | None) -> None:
        """See StreamStage."""
        self._state, self._kept = state, ""

    def add_reference(self, stamp: float, reference: Reference) -> None:
        """A measurement of another kind: counted, not used."""
        del stamp, reference
        self._unused[f"a reference, but metric_source is {self.source}"] += 1

    def started(self, reason: str | None) -> None:
        """A new stream has a unit of its own; what is known of the metres may be kept."""
        known = self._state if self._keeps else None
        self._state = None if known is None else restarted(known, FILTER)
        self._kept = f"kept from before a reset ({reason})" if self._state and reason else ""

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        """See StreamStage."""
        stamp, said = frame.stamp or 0.0, prediction.model_scale
        if prediction.state is None:  # no DyFN: this frame's unit is its own
            self._state = None
            return self._alone(frame, prediction)
        if said is not None:
            self._kept = ""
            self._state = update(self._state, stamp, math.log(said), NOISE**2, FILTER)
        if self._state is None:
            return self._without(frame, prediction)
        metres = math.exp(self._state.mean[0])
        measured = math.nan if self._state.stamp is None else stamp - self._state.stamp
        self.scale = ScaleInForce(
            self.source,
            MetricMap(metres),
            spread=math.sqrt(float(self._state.covariance[0, 0])),
            age=measured,
            problem=self._kept,
            kept=bool(self._kept),
        )
        return replace(prediction.scaled(metres), unit=np.float32(metres).item())

    def _alone(self, frame: Frame, prediction: Prediction[np.ndarray]) -> Prediction[np.ndarray]:
        if prediction.model_scale is None:
            return self._without(frame, prediction)
        self.scale = ScaleInForce(self.source, MetricMap(prediction.model_scale), age=0.0)
        return prediction.scaled(prediction.model_scale)

    def _without(self, frame: Frame, prediction: Prediction[np.ndarray]) -> Prediction[np.ndarray]:
        """No metres: withheld, or relative."""
        problem = "the model said nothing of metres"
        if frame.camera_matrix is None:
            problem = "the camera matrix is unknown, which this model needs for metres"
        self._unused[problem] += 1
        self.scale = ScaleInForce(self.source, problem=problem)
        return self._without_metres(prediction)
