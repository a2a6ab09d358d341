"""A whole sequence evaluated: scores, controls, latency, rows, and the pictures of it."""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from dyfn_core.evaluation.report.html import Cell, Table
from dyfn_core.evaluation.report.pictures import FrameStrip, curves
from dyfn_core.evaluation.report.worst_frames import WorstFrames
from dyfn_core.prediction import DEPTH
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_core.scoring.protocols import (
    CONTROLS,
    SequenceScore,
    SequenceScorer,
    spread,
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
    "scale",
    "shift",
)
PREDICTION = "prediction"
CONTROL_SAMPLES = (4_000, 800_000)  # of a frame, and of the sequence
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
    ) -> FrameScore:
        """One frame.

        image: H x W x 3 uint8 RGB. depth: H x W up to scale (or disparity); valid: H x W bool.
        truth: metres, NaN invalid, of the same field of view (any size); None when unknown.
        stamp, latency: seconds. Raises ValueError when truth has another aspect ratio.
        """
        masked = np.where(valid, depth, np.nan).astype(np.float32)
        self._hash.update(masked.tobytes())
        self.strip.add(len(self._stamps), image, masked, truth)
        self._stamps.append(stamp)
        self._latencies.append(latency)
        if truth is None:
            nothing = np.full((1, 1), np.nan, np.float32)
            self._scorers.push({PREDICTION: nothing}, nothing)
            return self.scorer.frames[-1]
        self._scorers.push({PREDICTION: masked}, truth)
        score = self.scorer.frames[-1]
        self.worst.add(len(self._stamps) - 1, image, masked, truth, score)
        return score

    @property
    def quantity(self) -> str:
        """What is pushed: depth or disparity."""
        return self.scorer.quantity

    @property
    def frames(self) -> int:
        """Frames pushed so far."""
        return len(self._stamps)

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

    def results(self) -> dict[str, Any]:
        """What goes into metrics.json: protocols (None without truth), controls, spread."""
        scorer = self.scorer
        video = self.video()
        return {
            "frames": self.frames,
            "image": _means(scorer.image()),
            "video": _means(video),
            "latency_ms": self.latency_ms(),
            "alignment": None if video is None else {"scale": video.scale, "shift": video.shift},
            "coverage": _coverage(scorer),
            "spread": spread(scorer.frames),
            "controls": {
                name: {"image": _means(control.image()), "video": _means(control.video())}
                for name, control in self.controls.items()
            },
            "output_sha256": self.output_hash,
        }

    def column(self, name: str) -> np.ndarray:
        """One of COLUMNS of every frame, float64; NaN where there is no truth."""
        scores, video = self.scorer.frames, self.video()
        protocol, _, metric = name.partition("_")
        if name == "frame":
            return np.arange(self.frames, dtype=np.float64)
        if name == "stamp":
            return np.array(self._stamps)
        if name == "latency_ms":
            return np.array(self._latencies) * 1000
        if protocol == "video":
            return np.full(self.frames, np.nan) if video is None else video.frames.column(metric)
        if protocol == "image":
            return scores.metrics.column(metric)
        return scores.column(name)

    def rows(self) -> Iterator[dict[str, Cell]]:
        """One dict of COLUMNS per frame; None where there is no truth."""
        columns = [self.column(name) for name in COLUMNS]
        for values in zip(*columns, strict=True):
            yield {
                name: int(value) if name in COUNTS else None if np.isnan(value) else float(value)
                for name, value in zip(COLUMNS, values, strict=True)
            }

    def draw_strip(self) -> np.ndarray:
        """The strip, aligned as the video protocol does (H x W x 3 uint8 RGB)."""
        video = self.video()
        return self.strip.draw(1, 0) if video is None else self.strip.draw(video.scale, video.shift)


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
    """Runs (name -> results()) and, below, the controls of the first, as one table."""
    header = ("", "image AbsRel", "delta1", "video AbsRel", "delta1", "scale spread", "p50 ms")
    rows: list[list[Cell]] = []
    for name, result in results.items():
        wandering = (result["spread"] or {}).get("log_scale_std")
        latency = result["latency_ms"] or {}
        p50 = latency.get("p50")
        rows.append([name, *_scores(result), wandering, None if p50 is None else round(p50, 1)])
    for name, control in next(iter(results.values()))["controls"].items():
        rows.append([f"control: {name}", *_scores(control), None, None])
    for row in rows:
        row[-1] = None if row[-1] is None else f"{row[-1]:.1f}"
    return Table(header, rows)


def _scores(result: Mapping[str, dict[str, float] | None]) -> list[Cell]:
    image, video = result["image"] or {}, result["video"] or {}
    return [scores.get(name) for scores in (image, video) for name in ("abs_rel", "delta1")]


def curve_picture(runs: Mapping[str, SequenceEvaluation]) -> np.ndarray:
    """Per-frame scale (over its median) and error over time, a line per run."""
    return curves(
        {
            "scale that fits each frame, over its median (flat is stable)": {
                name: over_median(run.column("scale")) for name, run in runs.items()
            },
            "AbsRel, one alignment for the sequence (video protocol)": {
                name: run.column("video_abs_rel") for name, run in runs.items()
            },
        }
    )


def over_median(values: np.ndarray) -> np.ndarray:
    """Values over the median of those that are not NaN; all NaN when that is 0 or nothing is."""
    middle = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
    return values / middle if middle else np.full(len(values), np.nan)
