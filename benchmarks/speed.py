"""Frames per second: the model alone, and the node end to end, as ratios within one run.

    python benchmarks/speed.py [--model dyfn-mini] [--threads 2] [--out speed.json]

Baselines: for the model, MoGe v1 ViT-S (random weights; speed does not depend on them) on the
same images with 392 tokens; for the node, the model alone. The node is fed raw frames of the demo
recording over DDS, one at a time, with subscribers on depth and cloud.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch

from dyfn_core import DepthStream, load_model
from dyfn_core.models.base import GeometryModel
from dyfn_core.models.moge import MoGeModel
from dyfn_ros.demo.node_process import NodeProcess
from dyfn_ros.node.environment import prepare_environment
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording

SIZES = {"320x240": (240, 320), "640x480": (480, 640)}
BASELINE_TOKENS = 392  # of 14 x 14 pixels: 320 x 240 in the network
VITS = {
    "encoder": "dinov2_vits14",
    "intermediate_layers": 4,
    "dim_proj": 512,
    "dim_upsample": [256, 128, 64],
    "dim_times_res_block_hidden": 2,
    "num_res_blocks": 2,
    "last_conv_channels": 32,
    "last_conv_size": 1,
    "remap_output": "exp",
}


def images(recording: Path, size: tuple[int, int], count: int) -> list[np.ndarray]:
    """The recording's first frames as H x W x 3 uint8 RGB of `size`."""
    frames = islice(open_recording(recording).frames(), count)
    return [cv2.resize(f.image, size[::-1], interpolation=cv2.INTER_LINEAR) for f in frames]


def milliseconds(
    model: GeometryModel,
    frames: list[np.ndarray],
    stabilize: bool,
    num_tokens: int | None = None,
) -> list[float]:
    """Time of each push after two to warm up."""
    stream, spent = DepthStream(model, stabilize=stabilize, num_tokens=num_tokens), []
    for frame in frames:
        start = time.perf_counter()
        stream.push(frame)
        spent.append(1e3 * (time.perf_counter() - start))
    return spent[2:]


def node_milliseconds(name: str, frames: list[np.ndarray], folder: Path) -> list[float]:
    """Time from publishing an image to having its depth and cloud, per frame."""
    height, width = frames[0].shape[:2]
    matrix = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])

    def made() -> Iterator[FrameToRecord]:
        for index, frame in enumerate(frames):
            yield FrameToRecord(frame, None, matrix, None, 1000.0 + index / 15)

    path = folder / f"raw_{width}"
    write_rgbd_recording(path, made(), jpeg_quality=None)
    recording = open_recording(path)
    domain = 1 + os.getpid() % 100
    prepare_environment()
    os.environ |= {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    from dyfn_ros.demo.live_player import LivePlayer

    source = next(recording.frames())
    space = f"/dyfn_speed_{os.getpid()}"
    parameters = {"model": name, "drop_frames": False, "wait_for_camera_info": True}
    with (
        NodeProcess(folder / "node.log", parameters, space) as process,
        LivePlayer(process, source.source.kind, domain, space) as player,
    ):
        player.prime(source)
        player.reset(stabilize=True)
        return [1e3 * r.latency for r in player.play(recording.frames())][2:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="dyfn-mini")
    parser.add_argument("--recording", type=Path, default=Path("bags/demo"))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    os.environ["OMP_NUM_THREADS"] = str(options.threads)
    model, baseline = load_model(options.model), MoGeModel.from_config(VITS).eval()
    results: dict[str, dict[str, float]] = {}
    for label, size in SIZES.items():
        frames = images(options.recording, size, options.frames)
        with tempfile.TemporaryDirectory() as folder:
            rows = {
                "MoGe v1 ViT-S, base": milliseconds(baseline, frames[:8], False, BASELINE_TOKENS),
                f"{options.model}, base": milliseconds(model, frames, stabilize=False),
                f"{options.model}, DyFN": milliseconds(model, frames, stabilize=True),
                f"{options.model}, DyFN, node": node_milliseconds(
                    options.model, frames, Path(folder)
                ),
            }
        slowest = statistics.median(next(iter(rows.values())))
        for name, spent in rows.items():
            middle = statistics.median(spent)
            ratio = slowest / middle
            results.setdefault(label, {})[name] = middle
            print(f"{label}  {name:32s} {middle:8.1f} ms  {1e3 / middle:6.1f} fps  x{ratio:.1f}")
    if options.out:
        options.out.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
