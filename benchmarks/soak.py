"""Memory and latency of the node over many frames: flat and stable, or not.

    python benchmarks/soak.py [--frames 20000] [--size 640x480] [--model dyfn-mini]
        [--num-tokens 0] [--out soak.json]

Frames go over DDS one at a time, with a subscriber on every output. Resident memory and latency
are taken in ten stretches; between two of them the stream is reset or the images change their size
(half, or back). Exit code 1 when memory grows by more than --grow MB from the second stretch to
the last, or the median latency of the last stretch is more than 1.5 times that of the first one of
its size.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cameras import Feeder

from dyfn_ros.demo.node_process import NodeProcess
from dyfn_ros.node.environment import prepare_environment

STRETCHES = 10
PATIENCE = 5.0  # seconds without an answer


def resident(pid: int) -> float:
    """Megabytes."""
    status = Path(f"/proc/{pid}/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def stretch(feeder: Feeder, process: NodeProcess, frames: int) -> dict[str, float]:
    """So many frames of the one camera. A reset drops the frame that waits: it is sent again."""
    first, last = feeder.count["camera"], time.monotonic()
    feeder.latency.clear()
    feeder.others = 0
    seen, dropped = first, 0
    while feeder.count["camera"] - first < frames:
        feeder.spin()
        if feeder.count["camera"] != seen:
            seen, last = feeder.count["camera"], time.monotonic()
        elif time.monotonic() - last > PATIENCE:
            process.check()
            dropped += 1
            if dropped > 1:
                raise TimeoutError(f"a second frame was lost after {seen} frames")
            feeder.resend("camera")
            last = time.monotonic()
    return {
        "frames": feeder.count["camera"],
        "dropped": dropped,
        "other_outputs": feeder.others,
        "resident_mb": resident(process.pid),
        "latency_p50_ms": statistics.median(feeder.latency) * 1e3,
        "latency_p99_ms": float(np.quantile(feeder.latency, 0.99)) * 1e3,
    }


def pictures(width: int, height: int) -> list[np.ndarray]:
    """A view that drifts to the right and back: no scene cuts."""
    coarse = np.random.default_rng(0).integers(0, 256, (height // 16, width // 16, 3))
    view = cv2.resize(coarse.astype(np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    steps = [*range(8), *range(6, 0, -1)]
    return [np.roll(view, step * width // 200, axis=1) for step in steps]


def soak(options: argparse.Namespace) -> list[dict[str, float]]:
    """One row per stretch."""
    import rclpy

    width, height = (int(part) for part in options.size.split("x"))
    images = pictures(width, height)
    parameters: dict[str, Any] = {
        "model": options.model,
        "cameras": "[camera]",
        "threads": options.threads,
        "reliability": "reliable",
    }
    if options.num_tokens:
        parameters["num_tokens"] = options.num_tokens
    namespace = f"/soak_{os.getpid()}"
    with (
        tempfile.TemporaryDirectory() as folder,
        NodeProcess(Path(folder) / "node.log", parameters, namespace) as process,
    ):
        rclpy.init()
        feeder = Feeder(["camera"], images, namespace, everything=True)
        try:
            feeder.prime(process)
            rows = []
            for index in range(STRETCHES):
                rows.append(stretch(feeder, process, options.frames // STRETCHES))
                print(
                    f"{rows[-1]['frames']:7.0f} frames  "
                    f"{rows[-1]['other_outputs']:7.0f} other messages  "
                    f"{rows[-1]['resident_mb']:7.1f} MB  "
                    f"p50 {rows[-1]['latency_p50_ms']:6.1f} ms  "
                    f"p99 {rows[-1]['latency_p99_ms']:6.1f} ms",
                    flush=True,
                )
                if index % 2:
                    feeder.resize()
                else:
                    feeder.reset()
            return rows
        finally:
            feeder.close()
            rclpy.try_shutdown()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--num-tokens", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--grow", type=float, default=20.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    prepare_environment()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    rows = soak(options)
    if options.out:
        options.out.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    grown = rows[-1]["resident_mb"] - rows[1]["resident_mb"]
    slower = rows[-1]["latency_p50_ms"] / rows[1]["latency_p50_ms"]  # both of the first size
    print(f"memory grew by {grown:.1f} MB, the median latency to {slower:.2f} times what it was")
    return 1 if grown > options.grow or slower > 1.5 else 0


if __name__ == "__main__":
    sys.exit(main())
