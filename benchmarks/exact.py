"""What it costs that the bits do not depend on the number of threads: ours against torch's layers.

    python benchmarks/exact.py [--model dyfn-mini] [--threads 1 2] [--frames 60]

The frames alternate between the two, so that whatever else the machine does slows both. Prints
the median CPU milliseconds (of all threads) and wall milliseconds of a frame, and their ratio.
"""

from __future__ import annotations

import argparse
import hashlib
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path
from unittest import mock

import cv2
import numpy as np
import torch

from dyfn_core import DepthStream, load_model
from dyfn_core.models import deterministic as exact
from dyfn_core.models.base import GeometryModel
from dyfn_ros.node.environment import prepare_environment
from dyfn_ros.recordings.open import open_recording

SIZES = ((320, 240), (640, 480))


@contextmanager
def torchs_own() -> Iterator[None]:
    """torch's choice of libraries and of resizing within the block."""
    with (
        mock.patch.object(exact, "_is_onednn", return_value=False),
        mock.patch.object(exact, "FEW_CHANNELS", 0),
    ):
        yield


def timed(stream: DepthStream, frame: np.ndarray) -> tuple[float, float, bytes]:
    """CPU and wall milliseconds of a push, and the depth's bytes."""
    cpu, wall = time.process_time(), time.perf_counter()
    prediction = stream.push(frame)
    spent = 1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall)
    return *spent, prediction.depth.numpy().tobytes()


def compare(model: GeometryModel, frames: list[np.ndarray], stabilize: bool) -> tuple[str, str]:
    """-> a line on cost, and the hash of our depth."""
    ours, theirs = (DepthStream(model, stabilize=stabilize) for _ in range(2))
    spent: list[list[float]] = []
    digest = hashlib.sha256()
    for frame in frames:
        cpu, wall, depth = timed(ours, frame)
        digest.update(depth)
        with torchs_own():
            spent.append([cpu, wall, *timed(theirs, frame)[:2]])
    cpu, wall, own_cpu, own_wall = (statistics.median(one) for one in zip(*spent[2:], strict=True))
    line = f"CPU {cpu:6.1f} / {own_cpu:6.1f} ms = {cpu / own_cpu:.2f}  "
    return (
        line + f"wall {wall:6.1f} / {own_wall:6.1f} ms = {wall / own_wall:.2f}",
        digest.hexdigest(),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--recording", type=Path, default=Path("bags/demo"))
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--frames", type=int, default=60)
    options = parser.parse_args()
    model = load_model(options.model)
    raw = [frame.image for frame in islice(open_recording(options.recording).frames(), 30)]
    for size in SIZES:
        frames = [cv2.resize(image, size) for image in islice(cycle(raw), options.frames)]
        for stabilize in (False, True):
            for threads in options.threads:
                torch.set_num_threads(threads)
                line, digest = compare(model, frames, stabilize)
                name = "DyFN" if stabilize else "base"
                print(f"{size[0]}x{size[1]} {name} {threads} threads  {line}  {digest[:8]}")


if __name__ == "__main__":
    prepare_environment()
    main()
