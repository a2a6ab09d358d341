"""The metric scale of one stream, whatever it comes from: one interface over three sources."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from dyfn_core.metric.calibration import CalibrationOptions, ScaleCalibrator, ScalePrior
from dyfn_core.metric.fit import MetricMap
from dyfn_core.metric.ground import GroundView, ground_evidence, up_from_pitch
from dyfn_core.metric.references import Evidence

SOURCES = ("none", "fixed", "reference", "camera_height")
RELATIVE = MetricMap(1.0)


@dataclass(frozen=True)
class ScaleOptions:
    """Where metres come from.

    source: "none" (depth stays relative), "fixed" (metric_scale), "reference" (measurements
    pushed beside the frames) or "camera_height" (over the ground, metres).
    metric_scale: metres in one unit of the stream. up: 3, up in the optical frame, for
    "camera_height"; default a level camera.
    """

    source: str = "none"
    metric_scale: float = 1.0
    camera_height: float = 0.0
    up: tuple[float, float, float] = field(default_factory=lambda: tuple(up_from_pitch(0.0)))
    calibration: CalibrationOptions = field(default_factory=CalibrationOptions)

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ValueError(f"source {self.source!r} is unknown, expected one of {SOURCES}")
        if self.source == "fixed" and not (
            math.isfinite(self.metric_scale) and self.metric_scale > 0
        ):
            raise ValueError(f"metric_scale must be positive, got {self.metric_scale}")
        if self.source == "camera_height":
            if not (math.isfinite(self.camera_height) and self.camera_height > 0):
                raise ValueError(f"camera_height must be positive metres, got {self.camera_height}")
            length = float(np.linalg.norm(self.up))
            if len(self.up) != 3 or not math.isfinite(length) or length == 0:
                raise ValueError(f"up must be a vector of three numbers, got {self.up}")


@dataclass(frozen=True)
class ScaleInForce:
    """What a frame's depth means.

    source: as in ScaleOptions; map: None while the depth is relative. spread: relative standard
    deviation of what the scale was found from (0 for a fixed one, NaN unknown).
    age: seconds since a measurement last agreed with it (0 for a fixed one, NaN unknown).
    points: pairs behind the last agreeing fit. disagrees: the measurements contradict it.
    problem: why there is none, or what speaks against it; "" if all is well. kept: the scale is
    of before a reset of the stream or a calibration, and nothing has been measured since.
    """

    source: str
    map: MetricMap | None = None
    spread: float = math.nan
    age: float = math.nan
    points: int = 0
    disagrees: bool = False
    recalibrations: int = 0
    problem: str = ""
    kept: bool = False

    @property
    def metric(self) -> bool:
        """Whether depth is in metres."""
        return self.map is not None

    @property
    def warning(self) -> str:
        """What a user who configured a source must know; "" when it does what it should."""
        if self.source == "none":
            return ""
        return self.problem if self.disagrees or self.kept or not self.metric else ""

    def described(self) -> dict[str, str]:
        """Name and value of everything that is known, as texts."""
        values = {
            "unit": "metres" if self.metric else "relative",
            "source": self.source,
            "scale": f"{self.map.scale:.6g}" if self.map else "none",
        }
        if self.map and self.map.shift:
            values["shift"] = f"{self.map.shift:.6g}"
        values["spread"] = "unknown" if math.isnan(self.spread) else f"{self.spread:.4f}"
        values["age"] = "unknown" if math.isnan(self.age) else f"{self.age:.3f} s"
        values["points"] = str(self.points)
        values["disagrees"] = str(self.disagrees).lower()
        values["recalibrations"] = str(self.recalibrations)
        values["kept over a reset"] = str(self.kept).lower()
        if self.problem:
            values["problem"] = self.problem
        return values


class MetricScale:
    """The scale of one stream over time.

    A reset of the stream begins a new unit, so it ends a calibration found from measurements. Its
    scale is kept, less certain, until the next one, or forgotten; a fixed scale stays.
    """

    def __init__(self, options: ScaleOptions | None = None) -> None:
        self.options = options or ScaleOptions()
        self.calibrator = ScaleCalibrator(self.options.calibration)

    def reset(self, keep: bool = False) -> None:
        """The stream was reset. keep: see ScaleCalibrator.reset."""
        self.calibrator.reset(keep)

    def push(
        self, view: GroundView, stamp: float, measured: Sequence[Evidence] = ()
    ) -> ScaleInForce:
        """A frame's predicted geometry, and what has been measured -> what is in force.

        stamp: seconds. measured: beside this frame or earlier ones. The result already contains it.
        """
        if self.options.source == "reference":
            for evidence in measured:
                self.calibrator.push(evidence)
        elif self.options.source == "camera_height":
            up = np.array(self.options.up)
            self.calibrator.push(ground_evidence(view, up, self.options.camera_height, stamp))
        return self.in_force(stamp)

    def in_force(self, now: float) -> ScaleInForce:
        """now: seconds, on the clock of the frames' stamps."""
        source = self.options.source
        if source == "none":
            return ScaleInForce(source, problem="no metric source is configured")
        if source == "fixed":
            return ScaleInForce(source, MetricMap(self.options.metric_scale), 0.0, 0.0)
        state = self.calibrator.state
        if state.map is None and state.prior is not None:
            return _kept(source, state.prior, state.problem)
        if state.map is None:
            return ScaleInForce(source, problem=state.problem or "no measurement yet")
        age = math.nan if state.stamp is None else max(now - state.stamp, 0.0)
        return ScaleInForce(
            source,
            state.map,
            state.spread,
            age,
            state.points,
            state.disagrees,
            state.recalibrations,
            state.problem,
        )


def _kept(source: str, prior: ScalePrior, problem: str) -> ScaleInForce:
    reason = problem or "no measurement since"
    return ScaleInForce(
        source,
        prior.map,
        prior.spread,
        points=prior.points,
        problem=f"kept from before {prior.before}: {reason}",
        kept=True,
    )


def to_metres(
    points: np.ndarray, depth: np.ndarray, metric_map: MetricMap
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """points H x W x 3, depth H x W -> the same in metres, and where they are before the camera.

    A shift moves every point along its own ray, so that it still projects onto its pixel.
    """
    if metric_map.shift == 0:
        scale = np.float32(metric_map.scale)
        return points * scale, depth * scale, np.ones(depth.shape, bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        metres = metric_map(depth).astype(np.float32)
        stretched = points * (metres / depth)[..., None]
    return stretched, metres, metres > 0
