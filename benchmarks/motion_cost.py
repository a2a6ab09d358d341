"""CPU time of the parts of metric_source odometry, on a folder with poses.

    python benchmarks/motion_cost.py FOLDER [--every N] [--frames 60] [--size 640 480]

FOLDER is an RGB-D folder with intrinsics, depth and poses. Its depth stands for the prediction:
the network does not run. Pictures are resized. The times are time.process_time (all threads of the
process; OpenCV gets one), the mean and the median over the frames.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.frames import DataReport
from dyfn_core.data.rgbd.layouts import open_folder
from dyfn_core.geometry.camera import pixel_intrinsics
from dyfn_core.metric.motion_scale import MotionFrame, MotionScaleOptions, MotionScaleState, step

RATE = 10.0  # frames a second of a folder without stamps


def frames(folder: Path, every: int, count: int, size: tuple[int, int]) -> Iterator[MotionFrame]:
    """Frames with a pose and depth; size: width and height."""
    opened = open_folder(folder, DataReport(str(folder)))
    for index, files in enumerate(opened.frames[::every][:count]):
        if files.pose is None or files.depth is None:
            continue
        frame = opened.read(files)
        fx, fy, cx, cy = frame.intrinsics.astype(np.float64)
        normalised = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        depth = cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST)
        yield MotionFrame(
            cv2.resize(np.ascontiguousarray(frame.image), size),
            index * every / RATE if files.stamp is None else files.stamp,
            pixel_intrinsics(normalised, (size[1], size[0])),
            files.pose,
            np.asarray(depth, np.float32),
            np.asarray(np.isfinite(depth) & (depth > 0)),
        )


def milliseconds(stream: list[MotionFrame], options: MotionScaleOptions) -> np.ndarray:
    """CPU time of each step."""
    state, found = MotionScaleState(), []
    for frame in stream:
        begun = time.process_time()
        state, scale = step(state, frame, options)
        scale.relative(frame.depth)
        found.append(1e3 * (time.process_time() - begun))
    return np.array(found)


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--every", type=int, default=1, help="use every Nth frame")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480], help="width and height")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    stream = list(frames(options.folder, options.every, options.frames, tuple(options.size)))
    whole = MotionScaleOptions()
    field = replace(whole, memory=replace(whole.memory, seconds=0.0))
    parts = {"tracks, triangulation, scale": replace(field, field=None)}
    parts |= {"+ field": field, "+ memory": whole}
    print("| | mean ms | median ms |", "| --- | --- | --- |", sep="\n")
    for name, variant in parts.items():
        spent = milliseconds(stream, variant)
        print(f"| {name} | {spent.mean():.1f} | {np.median(spent):.1f} |", flush=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(3):
        milliseconds(stream, whole)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(f"\nPeak memory grew by {grown / 1024:.1f} MB over {3 * len(stream)} further frames.")


if __name__ == "__main__":
    main()
