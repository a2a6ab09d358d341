"""Scale from the camera's own motion, with its parts added one by one, on recordings with poses.

    python benchmarks/scale_from_motion.py SOURCE... [--every N] [--seeds 0 1] [--whole] [--stops 8]

SOURCE is an RGB-D folder with intrinsics, depth and poses (poses.txt), a bag with depth and the
topics of bags/demo, or the folder of a rendered clip (dyfn-worlds). The network runs once per
frame with DyFN and once without; every row then corrects the same predictions:
    base, DyFN     the network's own unit
    + scale        the filtered log scale
    + shift        the filtered shift of depth as well, by ShiftFilter below
    + field        scale and the smooth field of log scale
    + memory       the points of the last seconds as well: what metric_source odometry does
    + all, shift   the filtered shift under all of it
    base + memory  the same without DyFN
--whole prints DyFN and + memory alone, and how much worse than DyFN the worst row is.
--stops S... prints another table: + memory with noisy odometry that stops after S seconds, the
metric AbsRel before and after, beside that of an odometry that goes on.
"true" poses are those of the recording, "robot's" those of its odometry topic, "noisy" ones have
the errors of OdometryNoise, one row per seed; "bad" ones are 5% too long, with random walks of 3%
and 1 degree, and say nothing of it. image and video align each frame, or all frames, by a scale
and a shift; metric aligns nothing and counts the frames that have metres (AbsRel/delta1). The last
columns are the video AbsRel against DyFN's, and CPU time (time.process_time).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from motion_recordings import Predicted, predicted

from dyfn_core.metric.motion import log_ratios
from dyfn_core.metric.motion_scale import MotionFrame, MotionScaleOptions, MotionScaleState, step
from dyfn_core.metric.odometry_noise import OdometryNoise, noisy_poses
from dyfn_core.scoring.protocols import SequenceScore, SequenceScorer

DEPTH_MAX = 10.0  # metres, of the truth
BAD = OdometryNoise(0.05, 0.03, 1.0)
HEAD = "| | | odometry | image | video | metric | in metres | to DyFN | CPU ms |"
STOPS = "| | odometry stops at | seed | before | after: goes on | stops | to before | to goes on |"


class Corrector:
    """One way to correct the predictions of a stream."""

    def __init__(self, options: MotionScaleOptions) -> None:
        self.options, self.state = options, MotionScaleState()

    def push(self, frame: MotionFrame) -> tuple[np.ndarray, np.ndarray | None]:
        """Relative depth, and metres where there are any."""
        self.state, scale = step(self.state, frame, self.options)
        return scale.relative(frame.depth), scale.metres(frame.depth)


class ShiftFilter(Corrector):
    """The same with the shift of depth as a further state.

    A shift moves log depth by k (median / depth - 1). Each frame's k is fitted to the log ratios
    of its points beside their scale (Cauchy weights), filtered, and returns to zero without
    points that tell; the prediction of the next frame has it before its scale is measured.
    """

    DEVIATION, SECONDS = 0.15, 2.0  # of k, and the time in which it falls to 1 / e
    NOISE, NEIGHBOURS, FEWEST = 0.03, 5.0, 20  # of a fit; points that err alike; points it needs

    def __init__(self, options: MotionScaleOptions) -> None:
        super().__init__(options)
        self.value, self.variance, self.stamp = 0.0, self.DEVIATION**2, math.nan

    def push(self, frame: MotionFrame) -> tuple[np.ndarray, np.ndarray | None]:
        """See Corrector."""
        elapsed = 0.0 if math.isnan(self.stamp) else frame.stamp - self.stamp
        keep = math.exp(-elapsed / self.SECONDS)
        self.stamp, self.value = frame.stamp, keep * self.value
        self.variance = keep**2 * self.variance + (1 - keep**2) * self.DEVIATION**2
        known = frame.valid & (frame.depth > 0)
        safe = np.where(known, frame.depth, 1.0)
        lever = np.clip(np.where(known, np.median(safe[known]) / safe - 1, 0.0), -1.0, 2.0)
        moved = replace(frame, depth=frame.depth * np.exp(self.value * lever).astype(np.float32))
        self.state, scale = step(self.state, moved, self.options)
        ratios = log_ratios(scale.points, frame.depth, frame.valid)
        good = np.isfinite(ratios) & (scale.points.sigma < self.options.motion.scale_sigma)
        if good.sum() >= self.FEWEST:
            columns, rows = np.rint(scale.points.pixels[good]).astype(int).T
            self._update(ratios[good], scale.points.sigma[good], lever[rows, columns])
        return scale.relative(moved.depth), scale.metres(moved.depth)

    def _update(self, ratios: np.ndarray, sigma: np.ndarray, lever: np.ndarray) -> None:
        variance = sigma**2 + 0.15**2
        weights = 1 / variance
        columns = np.column_stack([np.ones(len(lever)), lever])
        for _ in range(3):
            normal = columns.T @ (weights[:, None] * columns) + 1e-9 * np.eye(2)
            fit = np.linalg.solve(normal, columns.T @ (weights * ratios))
            weights = 1 / variance / (1 + ((ratios - columns @ fit) / 0.3) ** 2)
        noise = float(np.linalg.inv(normal)[1, 1]) * self.NEIGHBOURS + self.NOISE**2
        gain = self.variance / (self.variance + noise)
        self.value += gain * (float(fit[1]) - self.value)
        self.variance *= 1 - gain


@dataclass(frozen=True)
class Variant:
    """A row's name, its options, how it corrects, and whether it is on the base model."""

    name: str
    options: MotionScaleOptions
    kind: Callable[[MotionScaleOptions], Corrector] = Corrector
    base: bool = False


WHOLE = MotionScaleOptions()
FIELD = replace(WHOLE, memory=replace(WHOLE.memory, seconds=0.0))
SCALE = replace(FIELD, field=None)
MEMORY = Variant("+ memory", WHOLE)
VARIANTS = [
    Variant("+ scale", SCALE),
    Variant("+ shift", SCALE, ShiftFilter),
    Variant("+ field", FIELD),
    MEMORY,
    Variant("+ all, shift", WHOLE, ShiftFilter),
    Variant("base + scale", SCALE, base=True),
    Variant("base + shift", SCALE, ShiftFilter, True),
    Variant("base + memory", WHOLE, base=True),
]


class Row:
    """Scores of one way to correct the predictions of a recording."""

    def __init__(self, source: str, name: str, odometry: str) -> None:
        self.names = [source, name, odometry]
        self.relative, self.metric = (SequenceScorer(depth_max=DEPTH_MAX) for _ in range(2))
        self.metres, self.seconds = 0, 0.0

    def push(self, relative: np.ndarray, metres: np.ndarray | None, truth: np.ndarray) -> None:
        """Score a frame."""
        self.relative.push(relative, truth)
        if metres is not None:
            self.metric.push(metres, truth)
            self.metres += 1

    @property
    def video(self) -> float:
        """AbsRel of the video protocol."""
        score = self.relative.video()
        return math.nan if score is None else score.metrics["abs_rel"]

    def line(self, dyfn: float) -> str:
        """The row of the table; dyfn: video AbsRel of DyFN alone."""
        frames = len(self.relative.frames)
        scores = self.relative.image(), self.relative.video(), self.metric.metric()
        cells = [*self.names, *(_cell(score) for score in scores)]
        cells += [f"{self.metres} of {frames}", f"{100 * (self.video / dyfn - 1):+.1f}%"]
        return f"| {' | '.join(cells)} | {1e3 * self.seconds / frames:.1f} |"


def _cell(score: SequenceScore | None) -> str:
    if score is None:
        return "-"
    values = (score.metrics["abs_rel"], score.metrics["delta1"])
    return "/".join(f"{value:.3f}".removeprefix("0") for value in values)


def plain(source: str, frames: Sequence[Predicted]) -> list[Row]:
    """The rows without odometry: base and DyFN."""
    rows = [Row(source, "base", "-"), Row(source, "DyFN", "-")]
    for frame in frames:
        rows[0].push(frame.base, None, frame.truth)
        rows[1].push(frame.frame.depth, None, frame.truth)
    return rows


def corrected(row: Row, variant: Variant, frames: Sequence[Predicted]) -> Row:
    """A row with odometry."""
    corrector = variant.kind(variant.options)
    for one in frames:
        frame = one.frame
        if variant.base:
            frame = replace(frame, depth=one.base, valid=np.isfinite(one.base))
        begun = time.process_time()
        relative, metres = corrector.push(frame)
        row.seconds += time.process_time() - begun
        row.push(relative, metres, one.truth)
    return row


def odometries(frames: Sequence[Predicted], seeds: Sequence[int]) -> dict[str, list[Predicted]]:
    """The frames with the poses of each odometry, by its name."""
    true = [frame.frame.pose for frame in frames]
    poses = {"true": true}
    if all(frame.odometry is not None for frame in frames):
        poses["robot's"] = [frame.odometry for frame in frames]
    for seed in seeds:
        poses[f"noisy {seed}"] = noisy_poses(true, OdometryNoise(seed=seed))
        poses[f"bad {seed}"] = noisy_poses(true, replace(BAD, seed=seed))
    return {
        name: [
            replace(frame, frame=replace(frame.frame, pose=pose))
            for frame, pose in zip(frames, moved, strict=True)
        ]
        for name, moved in poses.items()
    }


def stopped(name: str, frames: Sequence[Predicted], seconds: Sequence[float], seed: int) -> None:
    """Print what the metres are worth after the odometry has stopped."""
    first = frames[0].frame.stamp
    true = [frame.frame.pose for frame in frames]
    poses = noisy_poses(true, OdometryNoise(seed=seed))
    for stop in seconds:
        scores = []
        for goes_on in (True, False):
            before, after = Row(name, "", ""), Row(name, "", "")
            corrector = Corrector(WHOLE)
            for one, pose in zip(frames, poses, strict=True):
                late = one.frame.stamp - first >= stop
                frame = replace(one.frame, pose=pose if goes_on or not late else None)
                relative, metres = corrector.push(frame)
                (after if late else before).push(relative, metres, one.truth)
            scores += [part.metric.metric() for part in (before, after)]
        known, on, _, off = (math.nan if s is None else s.metrics["abs_rel"] for s in scores)
        ratios = f"{off / known:.2f} | {off / on:.2f}"
        cells = " | ".join(f"{value:.3f}".removeprefix("0") for value in (known, on, off))
        print(f"| {name} | {stop:g} s | {seed} | {cells} | {ratios} |", flush=True)


def report(source: Path, options: argparse.Namespace) -> tuple[float, str]:
    """Print the rows of a recording; video AbsRel against DyFN of the worst row of + memory."""
    name, worst = source.name, (-math.inf, "")
    with torch.inference_mode():
        frames = list(predicted(source, options.model, options.every, options.max_frames))
    if options.stops:
        for seed in options.seeds:
            stopped(name, frames, options.stops, seed)
        return worst
    rows = plain(name, frames)
    dyfn = rows[1].video
    for row in rows[1:] if options.whole else rows:
        print(row.line(dyfn), flush=True)
    for odometry, moved in odometries(frames, options.seeds).items():
        for variant in [MEMORY] if options.whole else VARIANTS:
            row = corrected(Row(name, variant.name, odometry), variant, moved)
            print(row.line(dyfn), flush=True)
            if variant is MEMORY:
                worst = max(worst, (row.video / dyfn - 1, f"{name}, {odometry}"))
    return worst


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sources", type=Path, nargs="+")
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--every", type=int, default=1, help="use every Nth frame")
    parser.add_argument("--max-frames", type=int, default=None)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0], help="of the odometry's noise")
    parser.add_argument("--whole", action="store_true", help="only DyFN and + memory")
    parser.add_argument("--stops", type=float, nargs="*", default=[], help="seconds, of odometry")
    options = parser.parse_args()
    if options.stops:
        print(STOPS, "| --- " * 8 + "|", sep="\n")
        for source in options.sources:
            report(source, options)
        return
    print(HEAD, "| --- " * 9 + "|", sep="\n")
    share, where = max(report(source, options) for source in options.sources)
    print(f"\nWorst against DyFN: {100 * share:+.1f}% ({where}).")


if __name__ == "__main__":
    main()
