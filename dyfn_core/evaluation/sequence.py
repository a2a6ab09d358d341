"""A whole sequence evaluated: scores, controls, latency, rows, and the pictures of it."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from dyfn_core.evaluation.report.frame_grid import FrameStrip, ShownFrames
from dyfn_core.evaluation.report.html import Cell, Table
from dyfn_core.evaluation.report.pictures import curves
from dyfn_core.evaluation.report.worst_frames import WorstFrames
from dyfn_core.prediction import DEPTH
from dyfn_core.scoring.frame_scores import FrameScore, MetricRows
from dyfn_core.scoring.protocols import (
    CONTROLS,
    SequenceScore,
    SequenceScorer,
    drift,
    spread,
    to_shape,
    video_column,
)
from dyfn_core.scoring.variants import VariantScorers

COLUMNS = (
    "frame",
    "stamp",
    "latency_ms",
    "coverage",
    "pixels",
    "image_abs_rel",
    "image_delta1",
    "video_abs_rel",
    "video_delta1",
    "video_ratio",
    "scale",
    "shift",
)
PREDICTION = "prediction"
CONTROL_SAMPLES = (4_000, 800_000)  # of a frame, and of the sequence
METRIC_COLUMNS = ("metric_abs_rel", "metric_delta1")  # where depth was in metres
COUNTS = ("frame", "pixels")  # those of COLUMNS that are integers


class SequenceEvaluation:
    """Takes frames one at a time and says at the end how good they were.

    expected_frames: how many there will be, for the choice of the strip's frames.
    depth_max: cap of the ground truth in metres. quantity: what is pushed as depth; affine-
    invariant disparity is aligned as such (protocols.SequenceScorer). scorer: of what is pushed;
    controls: by name, on the same pixels; others of the same frames may be added at the end.
    """

    def __init__(
        self, expected_frames: int, depth_max: float = float("inf"), quantity: str = DEPTH
    ) -> None:
        self._scorers = VariantScorers(
            (PREDICTION,),
            quantity,
            scorer=lambda quantity: SequenceScorer(depth_max, quantity=quantity),
            control_scorer=lambda quantity: SequenceScorer(depth_max, *CONTROL_SAMPLES, quantity),
            controls={name: name for name in CONTROLS},
        )
        self.scorer = self._scorers.first
        self.controls = {name: self._scorers.scorers[name] for name in CONTROLS}
        self.strip = FrameStrip(expected_frames, quantity=quantity)
        self.worst = WorstFrames(expected_frames, quantity)
        self._stamps, self._latencies = array("d"), array("d")  # seconds
        self._metric = array("b")
        self._metres: SequenceScorer | None = None  # from the first frame in metres on
        self._depth_max = depth_max
        self._hash = hashlib.sha256()

    def push(
        self,
        image: np.ndarray,
        depth: np.ndarray,
        valid: np.ndarray,
        truth: np.ndarray | None,
        *,
        stamp: float,
        latency: float,
        metric: bool = False,
        steady: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> FrameScore:
        """One frame.

        image: H x W x 3 uint8 RGB. depth: H x W up to scale (or disparity); valid: H x W bool.
        truth: metres, NaN invalid, of the same field of view (any size); None when unknown.
        stamp, latency: seconds. metric: whether depth is in metres. steady: depth and valid in one
        unit for the whole sequence, for what is aligned, where the output has a unit that changes
        or is withheld at times; None: as depth and valid. Raises ValueError when truth has another
        aspect ratio.
        """
        output = np.where(valid, depth, np.nan).astype(np.float32)
        self._hash.update(output.tobytes())
        masked = output if steady is None else np.where(steady[1], steady[0], np.nan)
        masked = masked.astype(np.float32, copy=False)
        self.strip.add(len(self._stamps), image, masked, truth)
        self._stamps.append(stamp)
        self._latencies.append(latency)
        self._metric.append(metric)
        if truth is None:
            nothing = np.full((1, 1), np.nan, np.float32)
            self._scorers.push({PREDICTION: nothing}, nothing)
            self._push_metres(None, nothing)
            return self.scorer.frames[-1]
        self._scorers.push({PREDICTION: masked}, truth)
        score = self.scorer.frames[-1]
        self._push_metres(output if metric else None, truth)
        self.worst.add(len(self._stamps) - 1, image, masked, truth, score)
        return score

    def _push_metres(self, metres: np.ndarray | None, truth: np.ndarray) -> None:
        nothing = np.full((1, 1), np.nan, np.float32)
        if self._metres is None and metres is not None:
            self._metres = SequenceScorer(self._depth_max)
            for _ in range(self.frames - 1):
                self._metres.push(nothing, nothing)
        if self._metres is None:
            return
        if metres is None:
            metres = truth = nothing
        self._metres.push(to_shape(metres, truth.shape), truth)

    @property
    def quantity(self) -> str:
        """What is pushed: depth or disparity."""
        return self.scorer.quantity

    @property
    def frames(self) -> int:
        """Frames pushed so far."""
        return len(self._stamps)

    @property
    def scored_frames(self) -> int:
        """How many frames have scores."""
        return int(np.isfinite(self.scorer.frames.column("scale")).sum())

    @property
    def output_hash(self) -> str:
        """SHA-256 over the depth of every frame: float32, row-major, NaN where invalid."""
        return self._hash.hexdigest()

    def latency_ms(self) -> dict[str, float] | None:
        """Median and 99th percentile of the latency; None without frames."""
        return latency_marks(self.column("latency_ms"))

    def video(self) -> SequenceScore | None:
        """The sequence under the video protocol."""
        return self.scorer.video()

    @property
    def metric_frames(self) -> int:
        """How many frames were in metres."""
        return sum(self._metric)

    def metric(self) -> MetricRows | None:
        """Each frame under the metric protocol, None where it was not in metres or not scored.

        None when no frame was in metres, or there is no truth.
        """
        score = None if self._metres is None else self._metres.metric()
        if score is None:
            return None
        rows = MetricRows()
        for metrics, known in zip(score.frames, self._metric, strict=True):
            rows.append(metrics if known else None)
        return rows

    def results(self) -> dict[str, Any]:
        """What goes into metrics.json: protocols (None without truth), controls, spread.

        The metric protocol is there when frames were in metres; its means are over these.
        """
        scorer = self.scorer
        video, metric = self.video(), self.metric()
        return {
            "frames": self.frames,
            "scored_frames": self.scored_frames,
            "image": _means(scorer.image()),
            "video": _means(video),
            **({} if metric is None else {"metric": metric.means()}),
            "latency_ms": self.latency_ms(),
            "alignment": None if video is None else {"scale": video.scale, "shift": video.shift},
            "coverage": _coverage(scorer),
            "drift": drift(video),
            "spread": spread(scorer.frames),
            "controls": {
                name: {"image": _means(control.image()), "video": _means(control.video())}
                for name, control in self.controls.items()
            },
            "output_sha256": self.output_hash,
        }

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of a table of the frames: COLUMNS, and METRIC_COLUMNS where there are any."""
        return COLUMNS if self.metric() is None else (*COLUMNS, *METRIC_COLUMNS)

    def column(self, name: str) -> np.ndarray:
        """One of COLUMNS or METRIC_COLUMNS of every frame, float64.

        NaN where there is no truth, or no depth in metres.
        """
        scores, video = self.scorer.frames, self.video()
        protocol, _, metric = name.partition("_")
        if name == "frame":
            return np.arange(self.frames, dtype=np.float64)
        if name == "stamp":
            return np.array(self._stamps)
        if name == "latency_ms":
            return np.array(self._latencies) * 1000
        if protocol == "video":
            return video_column(video, metric, self.frames)
        if protocol == "image":
            return scores.metrics.column(metric)
        if protocol == "metric":
            rows = self.metric()
            return np.full(self.frames, np.nan) if rows is None else rows.column(metric)
        return scores.column(name)

    def rows(self) -> Iterator[dict[str, Cell]]:
        """One dict of `columns` per frame; None where there is no value."""
        names = self.columns
        columns = [self.column(name) for name in names]
        for values in zip(*columns, strict=True):
            yield {
                name: int(value) if name in COUNTS else None if np.isnan(value) else float(value)
                for name, value in zip(names, values, strict=True)
            }

    def shown_frames(self) -> ShownFrames:
        """The strip's frames, aligned as the video protocol does."""
        video = self.video()
        return self.strip.shown() if video is None else self.strip.shown(video.scale, video.shift)

    def draw_strip(self) -> np.ndarray:
        """The strip of shown_frames (H x W x 3 uint8 RGB)."""
        shown = self.shown_frames()
        return self.strip.draw(shown.scale, shown.shift)


def latency_marks(milliseconds: np.ndarray) -> dict[str, float] | None:
    """Median and 99th percentile of times; None without any."""
    if not milliseconds.size:
        return None
    p50, p99 = np.percentile(milliseconds, [50, 99])
    return {"p50": float(p50), "p99": float(p99)}


def _means(score: SequenceScore | None) -> dict[str, float] | None:
    return None if score is None else score.metrics


def _coverage(scorer: SequenceScorer) -> float | None:
    scored = scorer.frames.column("coverage")[~np.isnan(scorer.frames.column("scale"))]
    return float(np.mean(scored)) if scored.size else None


def score_table(results: Mapping[str, dict[str, Any]]) -> Table:
    """Runs (name -> results()) and, below, the controls of the first, as one table.

    Columns that no run has (without truth, not in metres) are left out, and so are controls
    without a score.
    """
    protocols = ("image", "video", "metric")
    scores = [text for name in protocols for text in (f"{name} AbsRel", "delta1")]
    rows: list[list[Cell]] = []
    for name, result in results.items():
        wandering = (result["drift"] or {}).get("log_std")
        latency = result["latency_ms"] or {}
        p50 = latency.get("p50")
        rows.append([name, *_scores(result, protocols), wandering, _one_digit(p50)])
    controls = {f"control: {n}": c for n, c in next(iter(results.values()))["controls"].items()}
    scored = {name: _scores(control, protocols) for name, control in controls.items()}
    rows += [[n, *s, None, None] for n, s in scored.items() if s != [None] * len(s)]
    header = ("", *scores, "drift", "p50 ms")
    kept = [i for i in range(len(header)) if any(row[i] is not None for row in rows)]
    return Table([header[i] for i in kept], [[row[i] for i in kept] for row in rows], [*scored])


def _one_digit(value: float | None) -> str | None:
    return None if value is None else f"{value:.1f}"


def _scores(result: Mapping[str, Any], protocols: Sequence[str]) -> list[Cell]:
    found = [result.get(protocol) or {} for protocol in protocols]
    return [scores.get(name) for scores in found for name in ("abs_rel", "delta1")]


def curve_picture(runs: Mapping[str, SequenceEvaluation]) -> np.ndarray:
    """Each frame's true depth over the predicted one and its error over time, a line per run."""
    return curves(
        {
            "true over predicted depth, one alignment for the sequence (1: no drift)": {
                name: run.column("video_ratio") for name, run in runs.items()
            },
            "AbsRel, one alignment for the sequence (video protocol)": {
                name: run.column("video_abs_rel") for name, run in runs.items()
            },
        }
    )
