"""The stage that turns relative depth into metres."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dyfn_core.metric.calibration import CalibrationOptions, ScaleCalibration
from dyfn_core.metric.ground import up_from_pitch
from dyfn_core.metric.pairing import Pairing
from dyfn_core.metric.references import Evidence, Reference
from dyfn_core.metric.scale import MetricScale, ScaleOptions, to_metres
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.resets import ANOTHER_CLOCK
from dyfn_core.stream.scale_stage import ScaleStage


def scale_options(options: StreamOptions) -> ScaleOptions:
    """The part of a stream's options that a MetricScale needs.

    Raises:
        ValueError: The source lacks what it needs, such as a camera_height above 0.
    """
    up = up_from_pitch(math.radians(options.camera_pitch))
    return ScaleOptions(
        source=options.metric_source,
        metric_scale=options.metric_scale,
        camera_height=options.camera_height,
        up=(float(up[0]), float(up[1]), float(up[2])),
        calibration=CalibrationOptions(
            mode=options.calibration,
            fit=options.calibration_fit,
            seconds=options.calibration_seconds,
            min_points=options.calibration_points,
            rate=options.tracking_rate,
            disagreement=options.reference_disagreement,
        ),
    )


_MOST_KEPT = 100  # predictions, however fast they come


@dataclass(frozen=True)
class _Predicted:
    """Depth of one frame in the stream's unit, kept for measurements: see DepthView."""

    stamp: float
    depth: np.ndarray
    valid: np.ndarray
    camera_matrix: np.ndarray
    frame_id: str


class MetricStage(ScaleStage):
    """Metres from a fixed scale, from measurements, or from the camera's height.

    While a source is configured and has no scale yet, depth is withheld (all invalid) unless
    `until_metric` asks for relative depth: one stream must not change its unit unnoticed.

    A measurement that comes after its image is laid beside the prediction of then, for as long as
    `reference_history` says; it counts from the next frame on. These predictions are not part of
    `state`.
    """

    saved_as = "calibration"

    def __init__(self, options: Callable[[], StreamOptions]) -> None:
        """options: See ScaleStage."""
        super().__init__(options)
        self._metric = MetricScale(scale_options(options()))
        self._pairing: Pairing[Reference] = Pairing(options().reference_tolerance)
        self._predicted: deque[_Predicted] = deque(maxlen=_MOST_KEPT)  # in order
        self._late = 0  # measurements that came after their image
        self.scale = self._metric.in_force(0.0)  # at the last frame

    @property
    def metres_per_unit(self) -> float | None:
        """1 when depth is in metres: what this stage gives is the unit; else None."""
        return 1.0 if self.scale.metric else None

    @property
    def measures(self) -> bool:
        """See ScaleStage."""
        return self._metric.options.source in ("reference", "camera_height")

    @property
    def state(self) -> ScaleCalibration:
        """See StreamStage."""
        return self._metric.calibrator.state

    def restore(self, state: ScaleCalibration | None) -> None:
        """See StreamStage."""
        self._metric.reset()
        self._predicted.clear()
        if state is not None:
            self._metric.calibrator.state = state

    def add_reference(self, stamp: float, reference: Reference) -> None:
        """A measurement, any thread; it counts from the next frame on, or waits for its own."""
        self._pairing.put(stamp, reference)

    def started(self, reason: str | None) -> None:
        """A new stream has a unit of its own: calibrations end or are kept as less certain."""
        self._metric.reset(self._keeps)
        self._predicted.clear()  # of another unit
        if reason in ANOTHER_CLOCK:
            self._pairing.clear()

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        """See StreamStage."""
        options, stamp = self._options(), frame.stamp or 0.0
        if options.metric_scale != self._metric.options.metric_scale:
            self._metric.options = replace(self._metric.options, metric_scale=options.metric_scale)
        if self._anew:
            self._anew = False
            self._metric.calibrator.begin_anew()
        measured = self._measured(frame, prediction)
        self.scale = scale = self._metric.push(prediction, stamp, measured)
        if scale.map is None:
            withheld = scale.source != "none" and options.until_metric == "withhold"
            nothing = np.zeros_like(prediction.mask)
            return replace(prediction, mask=nothing) if withheld else prediction
        if scale.map.shift == 0:
            return prediction.scaled(scale.map.scale)
        points, depth, before = to_metres(prediction.points, prediction.depth, scale.map)
        mask = prediction.mask & before
        return replace(prediction, points=points, depth=depth, mask=mask, metric=True)

    def _measured(self, frame: Frame, prediction: Prediction[np.ndarray]) -> list[Evidence]:
        """What has been measured beside this frame and those before it, in their order."""
        if self._metric.options.source != "reference":
            return []
        stamp, kept = frame.stamp or 0.0, self._predicted
        while kept and kept[0].stamp < stamp - self._options().reference_history:
            kept.popleft()
        now = _Predicted(
            stamp, prediction.depth, prediction.valid, prediction.camera_matrix, frame.frame_id
        )
        views = {view.stamp: view for view in (*kept, now)}
        pairs = self._pairing.take(stamp, [view.stamp for view in kept])
        self._late += sum(when != stamp for when, _ in pairs)
        if frame.stamp is not None:
            kept.append(now)
        nearest, farthest = self._options().reference_depths
        found = (reference.evidence(views[when], when) for when, reference in pairs)
        return [evidence.within(nearest, farthest) for evidence in found]

    def report(self) -> dict[str, str]:
        """See StreamStage."""
        if self._metric.options.source != "reference":
            return super().report()
        return {**super().report(), "scale: measured after their image": str(self._late)}

    @property
    def unused(self) -> Counter[str]:
        """How many measurements, or points of them, were not used, by reason."""
        return self._pairing.dropped + self._metric.calibrator.dropped
