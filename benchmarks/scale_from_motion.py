"""Scale from the camera's own motion, with its parts added one by one, on a folder with poses.

    python benchmarks/scale_from_motion.py FOLDER [--every N] [--seeds 0 1] [--model dyfn-mini]

FOLDER is an RGB-D folder with intrinsics, depth and poses (poses.txt). The network runs once per
frame with DyFN and once without; every row then corrects the same predictions:
    base, DyFN     the network's own unit
    + scale        the filtered log scale
    + field        the smooth field of log scale as well
    + memory       the points of the last seconds as well: what metric_source odometry does
    base + memory  the same without DyFN
"true" poses are those of the folder, "noisy" ones have the errors of OdometryNoise, one row per
seed; "bad" ones are 5% too long, with random walks of 3% and 1 degree, and say nothing of it.
image and video align each frame, or all frames, by a scale and a shift; metric aligns nothing and
counts the frames that have metres. The last column is CPU time (time.process_time).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dyfn_core import DepthStream, load_model
from dyfn_core.data.frames import DataReport
from dyfn_core.data.rgbd.layouts import open_folder
from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.metric.motion_scale import MotionFrame, MotionScaleOptions, MotionScaleState, step
from dyfn_core.metric.odometry_noise import OdometryNoise, noisy_poses
from dyfn_core.scoring.protocols import SequenceScore, SequenceScorer

DEPTH_MAX = 10.0  # metres, of the truth
BAD = OdometryNoise(0.05, 0.03, 1.0)
RATE = 10.0  # frames a second of a folder without stamps
HEAD = (
    "| | odometry | image AbsRel / delta1 | video AbsRel / delta1 | metric AbsRel / delta1 "
    "| in metres | CPU ms |"
)


@dataclass(frozen=True)
class Predicted:
    """One frame: `base` and `frame.depth` (DyFN) are predictions, `truth` is in metres."""

    frame: MotionFrame
    base: np.ndarray
    truth: np.ndarray


def predicted(folder: Path, model_name: str, every: int, count: int | None) -> Iterator[Predicted]:
    """Frames with a pose and depth, through the network with and without DyFN."""
    opened = open_folder(folder, DataReport(str(folder)))
    model = load_model(model_name)
    streams: list[DepthStream] = []
    for index, files in enumerate(opened.frames[::every][:count]):
        if files.pose is None or files.depth is None:
            continue
        frame = opened.read(files)
        height, width = frame.depth.shape
        fx, fy, cx, cy = frame.intrinsics.astype(np.float64)
        camera = pixel_intrinsics(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), (height, width))
        if not streams:
            streams = [
                DepthStream(model, camera_matrix=camera, stabilize=on) for on in (True, False)
            ]
        dyfn, base = (stream.push(frame.image) for stream in streams)
        depths = [np.where(p.mask, p.depth, np.nan).astype(np.float32) for p in (dyfn, base)]
        stamp = index * every / RATE if files.stamp is None else files.stamp
        image = np.ascontiguousarray(frame.image)
        valid = np.isfinite(depths[0])
        made = MotionFrame(image, stamp, camera, files.pose, depths[0], valid)
        yield Predicted(made, depths[1], frame.depth)


class Row:
    """Scores of one way to correct the predictions."""

    def __init__(self, name: str, odometry: str) -> None:
        self.name, self.odometry = name, odometry
        self.relative, self.metric = (SequenceScorer(depth_max=DEPTH_MAX) for _ in range(2))
        self.metres, self.seconds = 0, 0.0

    def push(self, relative: np.ndarray, metres: np.ndarray | None, truth: np.ndarray) -> None:
        """Score a frame."""
        self.relative.push(relative, truth)
        if metres is not None:
            self.metric.push(metres, truth)
            self.metres += 1

    def line(self) -> str:
        """The row of the table."""
        frames = len(self.relative.frames)
        scores = self.relative.image(), self.relative.video(), self.metric.metric()
        cells = [self.name, self.odometry, *(_cell(score) for score in scores)]
        cells += [f"{self.metres} of {frames}", f"{1e3 * self.seconds / frames:.1f}"]
        return f"| {' | '.join(cells)} |"


def _cell(score: SequenceScore | None) -> str:
    if score is None:
        return "-"
    return f"{score.metrics['abs_rel']:.3f} / {score.metrics['delta1']:.3f}"


def plain(frames: Sequence[Predicted]) -> list[Row]:
    """The rows without odometry."""
    rows = [Row("base", "-"), Row("DyFN", "-")]
    for frame in frames:
        rows[0].push(frame.base, None, frame.truth)
        rows[1].push(frame.frame.depth, None, frame.truth)
    return rows


def corrected(
    name: str, odometry: str, options: MotionScaleOptions, frames: Sequence[Predicted]
) -> Row:
    """A row with odometry."""
    row, state = Row(name, odometry), MotionScaleState()
    for frame in frames:
        begun = time.process_time()
        state, scale = step(state, frame.frame, options)
        relative = scale.relative(frame.frame.depth)
        metres = scale.metres(frame.frame.depth)
        row.seconds += time.process_time() - begun
        row.push(relative, metres, frame.truth)
    return row


def with_poses(frames: Sequence[Predicted], poses: Sequence[np.ndarray]) -> list[Predicted]:
    """The same frames with other poses."""
    return [
        replace(frame, frame=replace(frame.frame, pose=pose))
        for frame, pose in zip(frames, poses, strict=True)
    ]


def without_dyfn(frames: Sequence[Predicted]) -> list[Predicted]:
    """The same frames with the base model's predictions."""
    found = []
    for one in frames:
        frame = replace(one.frame, depth=one.base, valid=np.isfinite(one.base))
        found.append(replace(one, frame=frame))
    return found


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--every", type=int, default=1, help="use every Nth frame")
    parser.add_argument("--max-frames", type=int, default=None)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0], help="of the odometry's noise")
    options = parser.parse_args()
    with torch.inference_mode():
        frames = list(predicted(options.folder, options.model, options.every, options.max_frames))
    poses = [frame.frame.pose for frame in frames]
    odometries = {"true": poses}
    for seed in options.seeds:
        odometries[f"noisy, seed {seed}"] = noisy_poses(poses, OdometryNoise(seed=seed))
        odometries[f"bad, seed {seed}"] = noisy_poses(poses, replace(BAD, seed=seed))
    whole = MotionScaleOptions()
    field = replace(whole, memory=replace(whole.memory, seconds=0.0))
    variants = {"+ scale": replace(field, field=None), "+ field": field, "+ memory": whole}
    print(HEAD, "| --- | --- | --- | --- | --- | --- | --- |", sep="\n")
    for row in plain(frames):
        print(row.line(), flush=True)
    for odometry, moved in odometries.items():
        posed = with_poses(frames, moved)
        for name, variant in variants.items():
            print(corrected(name, odometry, variant, posed).line(), flush=True)
        print(corrected("base + memory", odometry, whole, without_dyfn(posed)).line(), flush=True)


if __name__ == "__main__":
    main()
