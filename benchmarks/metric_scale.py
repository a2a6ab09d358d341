"""Metric AbsRel over time, calibrated from a few points in the first second or from the ground.

    python benchmarks/metric_scale.py FOLDER [FOLDER ...] [--model dyfn-mini] [--out out/metric]

A FOLDER is a recording with depth, or a rendered clip (meta.json). The sparse reference is made
from its true depth: --points random pixels a frame, 2% noise, a share of --outliers replaced by
a uniform draw in 0.3..3 times the truth. No alignment is made: AbsRel is of metres. Rows:
    hold     calibrated on the first second, then held; the reference is not looked at again
    track    followed slowly, all the time
    frame    the frame's own median scale, from all true pixels: no scale can do better
    ground   known camera height and up vector (rendered rooms, whose floor is at 0)
    fixed 1  metric_scale = 1, the unit that the model happens to have
The frames run through a StreamSession with its defaults; docs/metric_scale.md has the results of
--scene-cut-threshold 0.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from dyfn_core import Frame, Prediction, load_model
from dyfn_core.data.rendered import read_shard
from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.metric.calibration import CalibrationOptions
from dyfn_core.metric.references import PointReference
from dyfn_core.metric.scale import MetricScale, ScaleOptions
from dyfn_core.models.base import GeometryModel
from dyfn_core.stream.metric_stage import MetricStage
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.session import StreamSession
from dyfn_core.stream.stages import StreamStage
from dyfn_ros.recordings.open import open_recording

CLIP_RATE = 5.0  # frames a second of rendered walks
NOISE = 0.02
ROWS = ("hold", "track", "frame", "ground", "fixed 1")


@dataclass(frozen=True)
class TrueFrame:
    """depth: H x W metres, NaN unknown. matrix: 3 x 3 pixels. up, height: of a rendered room."""

    image: np.ndarray
    depth: np.ndarray
    matrix: np.ndarray | None
    stamp: float
    up: np.ndarray | None = None
    height: float = 0.0


@dataclass
class Track:
    """One row's errors over one sequence: AbsRel and log scale error by frame."""

    abs_rel: list[float] = field(default_factory=list)
    log_scale: list[float] = field(default_factory=list)


def true_frames(folder: Path) -> Iterator[TrueFrame]:
    if not (folder / "meta.json").exists():
        for frame in open_recording(folder).frames():
            if frame.depth is not None:
                stamp = frame.stamp_ns * 1e-9
                yield TrueFrame(frame.image, frame.depth, frame.camera_matrix, stamp)
        return
    shard = read_shard(folder)
    for index in range(len(shard)):
        rendered = shard.read(index)
        image, depth = rendered.image, rendered.depth
        fx, fy, cx, cy = (float(value) for value in shard.intrinsics[index])
        matrix = pixel_intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), depth.shape)
        frame = TrueFrame(
            image, np.where(np.isfinite(depth), depth, np.nan), matrix, index / CLIP_RATE
        )
        if shard.world == "room" and shard.poses is not None:
            pose = shard.poses[index]
            frame = replace(frame, up=pose[2, :3], height=float(pose[2, 3]))
        yield frame


def sparse_points(
    frame: TrueFrame, matrix: np.ndarray, count: int, outliers: float, rng: np.random.Generator
) -> PointReference:
    """What a sparse sensor would measure: points in metres, some of them wrong."""
    rows, columns = np.nonzero(np.isfinite(frame.depth) & (frame.depth > 0.05))
    few = rng.choice(len(rows), min(count, len(rows)), replace=False)
    rows, columns = rows[few], columns[few]
    z = frame.depth[rows, columns] * (1 + NOISE * rng.standard_normal(len(rows)))
    wrong = rng.random(len(rows)) < outliers
    z[wrong] *= rng.uniform(0.3, 3, int(wrong.sum()))
    k = matrix
    x, y = (columns - k[0, 2]) / k[0, 0] * z, (rows - k[1, 2]) / k[1, 1] * z
    return PointReference(np.column_stack([x, y, z]))


class Beside(StreamStage):
    """A metric stage whose scale is read and whose metres are not used."""

    def __init__(self, mode: str) -> None:
        options = StreamOptions(metric_source="reference", calibration=mode)
        self.metric = MetricStage(lambda: options)
        self.seconds = 0.0

    def started(self, reason: str | None) -> None:
        self.metric.started(reason)

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        begin = time.process_time()
        self.metric.after_prediction(frame, prediction)
        self.seconds += time.process_time() - begin
        return prediction

    @property
    def scale(self) -> float | None:
        """In force at the last frame."""
        return self.metric.scale.map.scale if self.metric.scale.map else None


class Sensor(StreamStage):
    """Gives the stages that follow what a sparse sensor measures of the frame that is pushed."""

    def __init__(self, rows: Sequence[Beside], options: argparse.Namespace) -> None:
        self.rows, self.options = rows, options
        self.rng = np.random.default_rng(options.seed)
        self.truth: TrueFrame | None = None

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        assert self.truth is not None
        count, outliers = self.options.points, self.options.outliers
        points = sparse_points(self.truth, prediction.camera_matrix, count, outliers, self.rng)
        for row in self.rows:
            row.metric.add_reference(self.truth.stamp, points)
        return prediction


class Ground(StreamStage):
    """The height of a hand-held camera changes: the source is told its height at each frame."""

    def __init__(self) -> None:
        self.calibration = CalibrationOptions("track", min_points=3)
        self.metric: MetricScale | None = None
        self.truth: TrueFrame | None = None
        self.scale: float | None = None
        self.found = 0

    @property
    def refused(self) -> Counter[str]:
        """Frames without a ground plane, by reason."""
        return self.metric.calibrator.dropped if self.metric else Counter()

    def started(self, reason: str | None) -> None:
        if self.metric is not None:
            self.metric.reset()

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        truth = self.truth
        if truth is None or truth.up is None:
            return prediction
        up = (float(truth.up[0]), float(truth.up[1]), float(truth.up[2]))
        options = ScaleOptions("camera_height", 1.0, truth.height, up, self.calibration)
        if self.metric is None:
            self.metric = MetricScale(options)
        self.metric.options = options
        before = self.refused.total()
        found = self.metric.push(prediction, truth.stamp).map
        self.found += before == self.refused.total()
        self.scale = None if found is None else found.scale
        return prediction


class Sources:
    """A session over one sequence, and the rows' scales beside it."""

    def __init__(self, model: GeometryModel, stabilize: bool, options: argparse.Namespace) -> None:
        self.rows = {mode: Beside(mode) for mode in ("hold", "track")}
        self.sensor, self.ground = Sensor(list(self.rows.values()), options), Ground()
        self.session = StreamSession(
            model,
            StreamOptions(stabilize=stabilize, scene_cut_threshold=options.scene_cut_threshold),
            stages=[self.sensor, *self.rows.values(), self.ground],
        )
        self.frames = 0

    @property
    def seconds(self) -> float:
        """CPU time of one row's scale, all frames together."""
        return sum(row.seconds for row in self.rows.values()) / len(self.rows)

    def push(self, truth: TrueFrame) -> tuple[Prediction[np.ndarray], dict[str, float]]:
        """-> the frame's geometry, up to scale, and the scale of each row that has one now."""
        self.sensor.truth = self.ground.truth = truth
        prediction = self.session.push(Frame(truth.image, truth.stamp, truth.matrix))
        self.frames += 1
        found = {name: row.scale for name, row in self.rows.items()}
        scales = {"fixed 1": 1.0, "ground": self.ground.scale, **found}
        return prediction, {row: scale for row, scale in scales.items() if scale is not None}


def run(
    model: GeometryModel, folder: Path, stabilize: bool, options: argparse.Namespace
) -> tuple[np.ndarray, dict[str, Track], Sources]:
    """-> stamps (T), errors by row (NaN where a row has no scale yet), and the sources."""
    sources = Sources(model, stabilize, options)
    tracks, stamps = {row: Track() for row in ROWS}, []
    for frame in true_frames(folder):
        prediction, scales = sources.push(frame)
        usable = prediction.valid & np.isfinite(frame.depth)
        predicted, truth = prediction.depth[usable], frame.depth[usable]
        if not len(truth):
            continue
        own = float(np.median(truth / predicted))
        scales["frame"] = own
        stamps.append(frame.stamp)
        for row, track in tracks.items():
            scale = scales.get(row, np.nan)
            metres = predicted * scale
            track.abs_rel.append(float(np.mean(np.abs(metres - truth) / truth)))
            track.log_scale.append(float(np.log(scale / own)))
    return np.array(stamps) - stamps[0], tracks, sources


def window_mean(stamps: np.ndarray, values: list[float], start: float, end: float) -> float:
    inside = (stamps > start) & (stamps <= end)
    chosen = np.array(values)[inside]
    return float(np.nanmean(chosen)) if np.isfinite(chosen).any() else np.nan


def cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3f}"


Result = tuple[np.ndarray, dict[str, Track], Sources]


def table(title: str, results: dict[bool, list[Result]], windows: list[tuple[float, float]]) -> str:
    """Markdown: AbsRel (mean over sequences) by window, and how far off the scale is."""
    names = [f"{a:g} to {b:g} s" if b < 1e6 else f"after {a:g} s" for a, b in windows]
    lines = [
        f"\n{title}\n",
        f"| | | {' | '.join(names)} | scale off, after 1 s |",
        f"| --- | --- |{' --- |' * (len(names) + 1)}",
    ]
    for stabilize, runs in results.items():
        for row in ROWS:
            cells = [
                np.nanmean([window_mean(s, t[row].abs_rel, a, b) for s, t, _ in runs])
                if any(np.isfinite(t[row].abs_rel).any() for _, t, _ in runs)
                else np.nan
                for a, b in windows
            ]
            off = [np.abs(t[row].log_scale) for _, t, _ in runs]
            apart = [
                window_mean(s, list(o), 1.0, 1e9) for (s, _, _), o in zip(runs, off, strict=True)
            ]
            if not np.isfinite(cells).any():
                continue
            percent = np.expm1(np.nanmean(apart))
            lines.append(
                f"| {'DyFN' if stabilize else 'base'} | {row} | "
                f"{' | '.join(cell(c) for c in cells)} | {percent:.1%} |"
            )
    return "\n".join(lines)


def draw(path: Path, title: str, results: dict[bool, Result]) -> None:
    """Two panels over time: AbsRel in metres, and the scale against the frame's own."""
    figure = Figure(figsize=(10, 7), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True)
    colours = {"hold": "tab:red", "track": "tab:blue", "frame": "tab:gray", "ground": "tab:green"}
    for stabilize, (stamps, tracks, _) in results.items():
        for row, colour in colours.items():
            values = np.array(tracks[row].abs_rel)
            if not np.isfinite(values).any():
                continue
            label = f"{row}, {'DyFN' if stabilize else 'base'}"
            style = "-" if stabilize else ":"
            top.plot(stamps, smoothed(values), style, color=colour, label=label)
            if row != "frame":
                bottom.plot(stamps, smoothed(np.exp(tracks[row].log_scale)), style, color=colour)
    top.axvline(1.0, color="black", linewidth=0.8)
    bottom.axhline(1.0, color="black", linewidth=0.8)
    bottom.set_yscale("log")
    top.set_ylabel("AbsRel, metres, no alignment")
    bottom.set_ylabel("scale in force / frame's own")
    bottom.set_xlabel("seconds (running mean of 1 s)")
    top.set_title(title)
    top.legend(ncols=2, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure).print_png(str(path))


def smoothed(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Running mean that ignores NaN; NaN stays where there is nothing yet."""
    known = np.isfinite(values)
    kernel = np.ones(width)
    total = np.convolve(np.where(known, values, 0), kernel, "same")
    count = np.convolve(known.astype(float), kernel, "same")
    return np.where(known, total / np.maximum(count, 1), np.nan)


def main() -> None:
    """Run every folder with and without DyFN; print tables, draw the first folder's curves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--points", type=int, default=15, help="of the sparse reference, a frame")
    parser.add_argument("--outliers", type=float, default=0.2, help="share of wrong points")
    parser.add_argument(
        "--scene-cut-threshold", type=float, default=StreamOptions.scene_cut_threshold
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/metric"))
    options = parser.parse_args()
    model = load_model(options.model)
    choices = (False, True) if model.stabilizer is not None else (False,)
    results = {
        stabilize: [run(model, folder, stabilize, options) for folder in options.folders]
        for stabilize in choices
    }
    seconds = max(stamps[-1] for stamps, _, _ in results[choices[0]])
    bounds = [bound for bound in (1.0, 5.0, 10.0, 20.0, 30.0) if bound < 0.9 * seconds]
    windows = [*zip(bounds, [*bounds[1:], float(np.ceil(seconds))], strict=True), (1.0, 1e9)]
    print(table(f"{len(options.folders)} sequences, {options.model}", results, windows))
    draw(options.out / "curve.png", options.folders[0].name, {k: v[0] for k, v in results.items()})
    every = [sources for runs in results.values() for _, _, sources in runs]
    pushed = sum(sources.frames for sources in every)
    print(f"\n{1000 * sum(s.seconds for s in every) / pushed:.2f} ms a frame for the scale")
    with_ground = [s for s in every if s.ground.metric is not None]
    if with_ground:
        share = sum(s.ground.found for s in with_ground) / sum(s.frames for s in with_ground)
        print(f"ground plane found in {share:.0%} of the frames of rooms")
        refused: Counter[str] = Counter()
        for sources in with_ground:
            refused.update(sources.ground.refused)
        print(f"refused: {dict(refused.most_common())}")


if __name__ == "__main__":
    main()
