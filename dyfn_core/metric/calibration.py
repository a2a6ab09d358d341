"""From evidence over time to one metric scale: calibrate once, then hold it or follow slowly."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from dyfn_core.metric.fit import Fit, MetricMap, NoFitError, fit_scale, fit_scale_and_shift
from dyfn_core.metric.plausible import implausible
from dyfn_core.metric.references import Evidence

MODES = ("hold", "track")
FITS = ("scale", "scale_shift")
_ANOTHER_STREAM = 0.2  # standard deviation between the log scales of two streams of one camera
_PATIENT = 10  # evidence this many windows old is never used


@dataclass(frozen=True)
class CalibrationOptions:
    """How a scale is found and kept.

    mode: "hold" keeps the first calibration; "track" follows later fits slowly.
    fit: "scale", or "scale_shift" for streams whose shift is not known either.
    seconds: of evidence before the first calibration, and of the window that later fits are
        made on. min_points: pairs that a fit needs; max_spread: of their log ratios, at most.
    time_constant: seconds in which "track" makes up for two thirds of a difference;
        rate: its fastest change, in log units (0.05: 5%) a second.
    disagreement: log difference beyond which a fit contradicts the scale in force. It is not
        followed; when all fits of `patience` seconds contradict it, "hold" says so until they
        come back to within half of it, and "track" calibrates again.
    """

    mode: str = "hold"
    fit: str = "scale"
    seconds: float = 1.0
    min_points: int = 10
    max_spread: float = 0.35
    time_constant: float = 5.0
    rate: float = 0.05
    disagreement: float = 0.25
    patience: float = 3.0

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ValueError(f"mode {self.mode!r} is unknown, expected one of {MODES}")
        if self.fit not in FITS:
            raise ValueError(f"fit {self.fit!r} is unknown, expected one of {FITS}")
        for name in ("seconds", "max_spread", "time_constant", "rate", "disagreement", "patience"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if self.min_points < 2:
            raise ValueError(f"min_points must be at least 2, got {self.min_points}")


@dataclass(frozen=True)
class ScalePrior:
    """A scale that was in force, until there is another; a value.

    map: it was in force. spread: relative standard deviation, grown with each reset.
    points: pairs behind its last agreeing fit. before: what ended it.
    """

    map: MetricMap
    spread: float
    points: int
    before: str = "a reset"


@dataclass(frozen=True)
class ScaleCalibration:
    """All that a calibrator remembers; a value.

    map: in force; None before there is one. spread, points: of the last fit that agreed with
    it. stamp: of that fit; updated: of the last step of "track"; seconds.
    started: the first evidence's stamp. window: recent evidence. contradicted_since: stamp of
    the first of the unbroken run of fits that contradict the map; disagrees: for `patience`.
    recalibrations: how often "track" gave up a map. problem: why the last fit failed, or "".
    prior: what was known before the last reset, for as long as there is no map.
    """

    map: MetricMap | None = None
    spread: float = math.nan
    points: int = 0
    stamp: float | None = None
    updated: float | None = None
    started: float | None = None
    window: tuple[Evidence, ...] = ()
    contradicted_since: float | None = None
    disagrees: bool = False
    recalibrations: int = 0
    problem: str = ""
    prior: ScalePrior | None = None


class ScaleCalibrator:
    """Evidence in, a metric map out; deterministic in the evidence since the last reset.

    dropped: points that could not be used, by reason, over its whole life.
    """

    def __init__(self, options: CalibrationOptions | None = None) -> None:
        self.options = options or CalibrationOptions()
        self.state = ScaleCalibration()
        self.dropped: Counter[str] = Counter()

    def reset(self, keep: bool = False) -> None:
        """End the calibration: the stream's unit may be another one now.

        keep: remember the scale as a prior, 20% less certain.
        """
        state = self.state
        prior = state.prior
        if state.map is not None:
            prior = ScalePrior(state.map, state.spread, state.points)
        if prior is not None and keep:
            grown = math.hypot(prior.spread, _ANOTHER_STREAM)
            self.state = ScaleCalibration(prior=replace(prior, spread=grown))
        else:
            self.state = ScaleCalibration()

    def begin_anew(self) -> None:
        """Measure again in the same unit; what is known stays in force until that has worked."""
        state = self.state
        prior = state.prior
        if state.map is not None:
            asked = "the calibration that was asked for"
            prior = ScalePrior(state.map, state.spread, state.points, asked)
        self.state = ScaleCalibration(prior=prior)

    def push(self, evidence: Evidence) -> None:
        """One measurement. One without pairs moves nothing.

        It may be of an earlier frame than the one before, as if it had come in its place.
        """
        self.dropped.update(evidence.dropped)
        if not len(evidence.predicted):
            if self.state.map is None:
                reasons = ", ".join(sorted(evidence.dropped)) or "an empty measurement"
                self.state = replace(self.state, problem=f"nothing usable: {reasons}")
            return
        state = self.state
        now = self._latest(evidence.stamp)
        ordered = sorted((*state.window, evidence), key=lambda one: one.stamp)
        window = self._window(tuple(ordered), now)
        started = now if state.started is None else state.started
        self.state = state = replace(state, window=window, started=started)
        if state.map is None and now - started < self.options.seconds * (1 - 1e-9):
            return
        try:
            fit = self._fit(window)
        except NoFitError as problem:
            self.state = replace(state, problem=str(problem))
            return
        if state.map is None:
            self.state = self._calibrated(fit, now)
        else:
            self.state = self._compared(state.map, fit, now)

    def _latest(self, stamp: float) -> float:
        """Stamp of the latest evidence; of this one when its clock has been set back."""
        known = [one.stamp for one in self.state.window]
        if not known or max(known) - stamp > _PATIENT * self.options.seconds:
            return stamp
        return max(stamp, *known)

    def _window(self, window: tuple[Evidence, ...], now: float) -> tuple[Evidence, ...]:
        """Recent evidence, and older one as long as there are too few points without it."""
        seconds, points = self.options.seconds, 0
        kept: list[Evidence] = []
        for one in reversed(window):
            age = now - one.stamp
            if age < -seconds:  # of a clock that has been set back since
                continue
            if age > _PATIENT * seconds or (
                age > seconds * (1 + 1e-9) and points >= self.options.min_points
            ):
                break
            points += len(one.predicted)
            kept.append(one)
        return tuple(reversed(kept))

    def _fit(self, window: tuple[Evidence, ...]) -> Fit:
        fit = fit_scale if self.options.fit == "scale" else fit_scale_and_shift
        found = fit(
            np.concatenate([one.predicted for one in window]),
            np.concatenate([one.measured for one in window]),
            min_points=self.options.min_points,
            max_spread=self.options.max_spread,
        )
        middles = [one.middle for one in window if math.isfinite(one.middle)]
        if middles:
            metres = float(found.map(np.array(np.median(middles))))
            if problem := implausible(found.map.scale, metres):
                raise NoFitError(problem)
        return found

    def _calibrated(self, fit: Fit, now: float) -> ScaleCalibration:
        return replace(
            self.state,
            map=fit.map,
            spread=fit.spread,
            points=fit.inliers,
            stamp=now,
            updated=now,
            contradicted_since=None,
            disagrees=False,
            problem="",
        )

    def _compared(self, old: MetricMap, fit: Fit, now: float) -> ScaleCalibration:
        state, options = self.state, self.options
        apart = _log_difference(old, fit)
        limit = options.disagreement * (0.5 if state.disagrees else 1.0)
        if abs(apart) > limit:
            since = now if state.contradicted_since is None else min(state.contradicted_since, now)
            disagrees = state.disagrees or now - since >= options.patience
            if disagrees and options.mode == "track":
                state = self._calibrated(fit, now)
                return replace(state, recalibrations=state.recalibrations + 1)
            problem = f"the reference says {math.exp(apart):.2f} times the scale in force"
            return replace(
                state, contradicted_since=since, disagrees=disagrees, updated=now, problem=problem
            )
        new = old
        if options.mode == "track":
            new = self._step(old, fit.map, apart, now)
        return replace(
            state,
            map=new,
            spread=fit.spread,
            points=fit.inliers,
            stamp=now,
            updated=now,
            contradicted_since=None,
            disagrees=False,
            problem="",
        )

    def _step(self, old: MetricMap, new: MetricMap, apart: float, now: float) -> MetricMap:
        """Towards the new map, exponentially and no faster than `rate`."""
        elapsed = max(now - (self.state.updated or now), 0.0)
        elapsed = min(elapsed, self.options.seconds)  # a gap is no licence for a jump
        share = 1 - math.exp(-elapsed / self.options.time_constant)
        if abs(apart) > 0:
            share = min(share, self.options.rate * elapsed / abs(apart))
        scale = math.exp((1 - share) * math.log(old.scale) + share * math.log(new.scale))
        return MetricMap(scale, old.shift + share * (new.shift - old.shift))


def _log_difference(old: MetricMap, fit: Fit) -> float:
    """log(new / old) of the mapped depth in the middle of the points."""
    before = float(old(np.array(fit.level)))
    after = float(fit.map(np.array(fit.level)))
    return math.log(after / before) if before > 0 and after > 0 else math.inf
