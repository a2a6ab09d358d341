"""The image, video and metric protocols, accumulated one frame at a time (paper section 5)."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dyfn_core.geometry.l1_fit import fit_scale_shift
from dyfn_core.prediction import DEPTH, DISPARITY
from dyfn_core.scoring.fits import FITS, L1, LEAST_SQUARES
from dyfn_core.scoring.frame_scores import FrameScore, FrameScores, MetricRows
from dyfn_core.scoring.metrics import depth_metrics
from dyfn_core.scoring.samples import Samples

FARTHEST = 1e4  # metres: depth where aligned disparity is not positive, unless capped below
MIN_DEPTH = 1e-3  # truth at or below this (metres) is invalid; aligned depth is clipped to it
MIN_PIXELS = 16  # frames with fewer scored samples are not scored
ALL_PIXELS = 1 << 62  # as samples_per_frame and max_samples: nothing is left out


@dataclass(frozen=True)
class SequenceScore:
    """A sequence under one protocol: metrics are means over the scored frames.

    scale, shift: the one alignment of the video protocol (1 and 0 for the metric protocol,
    medians over frames for the image protocol). frames: each frame's metrics, None if unscored.
    ratios: each frame's true over aligned depth (median over its samples), NaN if unscored; under
    one alignment for the sequence it is how much nearer or farther that frame should have been.
    Empty for the image protocol.
    """

    metrics: dict[str, float]
    scale: float
    shift: float
    frames: MetricRows
    ratios: Sequence[float] = ()


class SequenceScorer:
    """Scores a sequence frame by frame, in memory that does not grow with resolution or length.

    Every frame is sampled on a regular pixel grid of at most samples_per_frame points; fits and
    scores of all protocols use these same points. When the kept samples of a sequence exceed
    max_samples, every second one of every frame is dropped, so that the video protocol of a long
    sequence is fitted and scored on fewer, still evenly spread pixels. Deterministic.

    depth_max: cap in metres: truth beyond it is invalid, aligned depth is clipped to it.
    quantity: "disparity" when predictions are affine-invariant disparity: every alignment is then
    min sum d |s p + t - 1/d|, and the inverse of the aligned disparity is scored as depth.
    fit: "l1", the paper's weighted one, or "lstsq", plain least squares without weights, against d
    (against 1/d for disparity).
    Invalid predictions (masked, NaN, infinite, not positive) take no part in fit or score; they
    lower `coverage` instead of counting as depth 0.
    """

    def __init__(
        self,
        depth_max: float = math.inf,
        samples_per_frame: int = 20_000,
        max_samples: int = 4_000_000,
        quantity: str = DEPTH,
        fit: str = L1,
    ) -> None:
        if quantity not in (DEPTH, DISPARITY):
            raise ValueError(
                f"quantity {quantity!r} is unknown, expected {DEPTH!r} or {DISPARITY!r}"
            )
        if fit not in FITS:
            raise ValueError(f"fit {fit!r} is unknown, expected one of {FITS}")
        self.quantity = quantity
        self.fit = fit
        self.depth_max = depth_max
        self.samples_per_frame = samples_per_frame
        self.max_samples = max_samples
        self.frames = FrameScores()
        self._kept = Samples()
        self._step = 1
        self._video: tuple[int, SequenceScore | None] = (0, None)  # frames, and their score

    def push(
        self, prediction: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None
    ) -> FrameScore:
        """Score one frame under the image protocol and keep its samples for the others.

        prediction: H x W depth (or disparity) up to scale and shift; target: H x W metres,
        invalid where it is NaN, infinite, <= MIN_DEPTH or > depth_max. mask: H x W bool, where
        the prediction is valid. Raises ValueError on differing shapes.
        """
        p, d, coverage = self._sample(prediction, target, mask)
        score = FrameScore(coverage, p.size)
        if p.size >= MIN_PIXELS:
            scale, shift = self._fit(p, d)
            score = FrameScore(coverage, p.size, scale, shift, self._score(p, d, scale, shift))
        self.frames.append(score)
        self._keep(p, d)
        return score

    def image(self) -> SequenceScore | None:
        """Each frame aligned by its own scale and shift; None when no frame could be scored."""
        means = self.frames.metrics.means()
        if means is None:
            return None
        scale, shift = (float(np.nanmedian(self.frames.column(c))) for c in ("scale", "shift"))
        return SequenceScore(means, scale, shift, self.frames.metrics)

    def video(self) -> SequenceScore | None:
        """One (scale, shift) for the sequence: min sum_j sum_i (1/d) |s p + t - d|."""
        if self._kept.most < MIN_PIXELS:
            return None
        if self._video[0] != len(self.frames):
            found = self._aligned(*self._fit(self._kept.prediction, self._kept.target))
            self._video = (len(self.frames), found)
        return self._video[1]

    def metric(self) -> SequenceScore | None:
        """No alignment: the prediction is taken as metres; disparity has none, hence None."""
        if self.quantity == DISPARITY or self._kept.most < MIN_PIXELS:
            return None
        return self._aligned(1.0, 0.0)

    def _fit(self, prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
        wanted = 1 / target if self.quantity == DISPARITY else target
        if self.fit == LEAST_SQUARES:
            return least_squares(prediction, wanted)
        return fit_scale_shift(prediction, wanted, 1 / wanted)

    def _aligned(self, scale: float, shift: float) -> SequenceScore:
        rows, ratios = MetricRows(), array("d")
        for p, d in self._kept:
            scored = p.size >= MIN_PIXELS
            rows.append(self._score(p, d, scale, shift) if scored else None)
            ratios.append(self._ratio(p, d, scale, shift) if scored else math.nan)
        means = rows.means()
        assert means is not None, "only of samples that are scorable"
        return SequenceScore(means, scale, shift, rows, ratios)

    def _ratio(
        self, prediction: np.ndarray, target: np.ndarray, scale: float, shift: float
    ) -> float:
        aligned = align_depth(prediction, scale, shift, self.quantity)
        return float(np.median(target / np.maximum(aligned, MIN_DEPTH)))

    def _score(
        self, prediction: np.ndarray, target: np.ndarray, scale: float, shift: float
    ) -> dict[str, float]:
        aligned = align_depth(prediction, scale, shift, self.quantity)
        return depth_metrics(np.clip(aligned, MIN_DEPTH, self.depth_max), target)

    def _sample(
        self, prediction: np.ndarray, target: np.ndarray, mask: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, float]:
        if prediction.shape != target.shape or (mask is not None and mask.shape != target.shape):
            raise ValueError(
                f"prediction {prediction.shape}, target {target.shape} and mask must share a shape"
            )
        grid = sample_grid(target.shape, self.samples_per_frame)
        p, d = prediction[grid].astype(np.float32), target[grid].astype(np.float32)
        truth = np.isfinite(d) & (d > MIN_DEPTH) & (d <= self.depth_max)
        valid = truth & predicted(p, self.quantity)
        if mask is not None:
            valid &= mask[grid]
        coverage = float(valid.sum() / truth.sum()) if truth.any() else 0.0
        return p[valid], d[valid], coverage

    def _keep(self, prediction: np.ndarray, target: np.ndarray) -> None:
        self._kept.append(prediction[:: self._step], target[:: self._step])
        if self._kept.size > self.max_samples:
            self._step *= 2
            self._kept = self._kept.halved()


def least_squares(prediction: np.ndarray, target: np.ndarray) -> tuple[float, float]:
    """The (scale, shift) that minimise sum (scale * prediction + shift - target)^2, unweighted.

    Arrays of one size. A constant prediction gives scale 1.
    """
    x, y = prediction.astype(np.float64).ravel(), target.astype(np.float64).ravel()
    x_mean, y_mean = x.mean(), y.mean()
    variance = np.mean((x - x_mean) ** 2)
    if variance <= 1e-24 * max(1.0, x_mean**2):
        return 1.0, float(y_mean - x_mean)
    scale = float(np.mean((x - x_mean) * (y - y_mean)) / variance)
    return scale, float(y_mean - scale * x_mean)


def predicted(prediction: np.ndarray, quantity: str = DEPTH) -> np.ndarray:
    """Where a prediction says something: finite and positive; disparity may be 0, far away."""
    valid: np.ndarray = np.isfinite(prediction)
    return valid & (prediction >= 0 if quantity == DISPARITY else prediction > 0)


def align_depth(
    prediction: np.ndarray, scale: float, shift: float, quantity: str = DEPTH
) -> np.ndarray:
    """The aligned prediction as depth, float64; aligned disparity <= 0 is FARTHEST away."""
    aligned: np.ndarray = scale * prediction.astype(np.float64) + shift
    return 1 / np.maximum(aligned, 1 / FARTHEST) if quantity == DISPARITY else aligned


def sample_grid(shape: tuple[int, ...], samples: int) -> tuple[slice, slice]:
    """Every s-th row and column, from s // 2, with s the smallest that gives <= samples points."""
    height, width = shape
    step = max(1, math.ceil(math.sqrt(height * width / samples)))
    return slice(step // 2, None, step), slice(step // 2, None, step)


def to_shape(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Nearest samples of an H x W array at another resolution of the same field of view.

    Raises ValueError when the aspect ratios differ by more than 2%.
    """
    if image.shape == shape:
        return image
    (height, width), (rows, columns) = image.shape, shape
    if abs(width * rows / (height * columns) - 1) > 0.02:
        raise ValueError(
            f"ground truth of {columns} x {rows} pixels does not show the same field of view as "
            f"images of {width} x {height}"
        )
    row = (np.arange(rows) * 2 + 1) * height // (2 * rows)
    column = (np.arange(columns) * 2 + 1) * width // (2 * columns)
    nearest: np.ndarray = image[row[:, None], column]
    return nearest


def ramp(shape: tuple[int, int]) -> np.ndarray:
    """Control: a vertical ramp from 2 (top) to 1 (bottom); what needs no network at all."""
    height, width = shape
    return np.repeat(np.linspace(2, 1, height, dtype=np.float32)[:, None], width, axis=1)


def constant(shape: tuple[int, int]) -> np.ndarray:
    """Control: the same depth everywhere."""
    return np.ones(shape, np.float32)


CONTROLS: dict[str, Callable[[tuple[int, int]], np.ndarray]] = {"ramp": ramp, "constant": constant}


def spread(frames: Sequence[FrameScore]) -> dict[str, float] | None:
    """How far scale and shift wander over the frames of a sequence; None under two scored frames.

    log_scale_std: standard deviation of log(scale) over frames with a positive scale;
    log_scale_max_step: its largest change between neighbours; shift_std: metres;
    not_positive: frames whose best scale is not positive (the prediction is upside down there).
    """
    fits = [(f.scale, f.shift) for f in frames if f.scale is not None and f.shift is not None]
    log_scale = np.log([s for s, _ in fits if s > 0])
    if log_scale.size < 2:
        return None
    return {
        "log_scale_std": float(np.std(log_scale)),
        "log_scale_max_step": float(np.abs(np.diff(log_scale)).max()),
        "shift_std": float(np.std([t for _, t in fits])),
        "not_positive": len(fits) - log_scale.size,
    }


def video_column(video: SequenceScore | None, name: str, frames: int) -> np.ndarray:
    """A column of the video protocol, one of METRICS or "ratio"; all NaN without scores."""
    if video is None:
        return np.full(frames, np.nan)
    return np.array(video.ratios) if name == "ratio" else video.frames.column(name)


def drift(video: SequenceScore | None) -> dict[str, float] | None:
    """How far the scale wanders over a sequence under its one alignment; None under two frames.

    log_std: standard deviation of the log of SequenceScore.ratios; max_step: the largest change of
    that log from one scored frame to the next.
    """
    if video is None:
        return None
    ratios = np.asarray(video.ratios)
    log_ratios = np.log(ratios[np.isfinite(ratios)])
    if log_ratios.size < 2:
        return None
    steps = np.abs(np.diff(log_ratios))
    return {"log_std": float(np.std(log_ratios)), "max_step": float(steps.max())}
