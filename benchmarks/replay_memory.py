"""Peak memory of a whole replay against the length of the recording: flat, or not.

    python benchmarks/replay_memory.py [--frames 300] [--size 320x240] [--grow MB] [OPTION ...]

Two recordings of a made room, --frames and four times as many, are replayed in processes of their
own with every output that is installed, ground truth and poses on. The camera goes round and
round, so that both see the same room and their fused clouds are alike. Any other OPTION goes to
dyfn-replay. Exit code 1 when the peak resident memory of the longer one is more than --grow MB
above that of the shorter.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording

LENGTHS = (1, 4)  # times --frames
ROUND = 120  # frames in which the camera is where it was
HALF_ROOM = np.array([2.0, 1.2, 3.0])  # metres
EXTRAS = {"video": "av", "rrd": "rerun"}  # output -> module of its extra
# The most that was ever resident, of this process alone: rusage would count its parent's too.
CHILD = """
import sys
from dyfn_ros.replay.cli import main
code = main(sys.argv[1:])
status = open("/proc/self/status").read()
print("peak_kb", next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
sys.exit(code)
"""


def room(count: int, size: tuple[int, int]) -> Iterator[FrameToRecord]:
    """A textured box seen from inside by a camera that turns and sways; exact depth in metres."""
    height, width = size
    focal = 0.8 * width
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays = pixels @ np.linalg.inv(matrix).T
    for index in range(count):
        turn = 2 * np.pi * index / ROUND
        pose = np.eye(4)
        pose[0, [0, 2]] = np.cos(turn), np.sin(turn)
        pose[2, [0, 2]] = -np.sin(turn), np.cos(turn)
        pose[:3, 3] = 0.6 * np.sin(turn), 0.2 * np.cos(turn), 0.8 * np.sin(2 * turn)
        turned = rays @ pose[:3, :3].T
        with np.errstate(divide="ignore"):
            depth = ((np.sign(turned) * HALF_ROOM - pose[:3, 3]) / turned).min(axis=-1)
        hit = pose[:3, 3] + turned * depth[..., None]
        waves = np.sin(hit * [7, 9, 5])[..., [1, 2, 0]] + np.sin(hit * [17, 13, 19] + [1, 2, 3])
        image = np.clip(127 + 60 * waves, 0, 255).astype(np.uint8)
        yield FrameToRecord(image, depth.astype(np.float32), matrix, pose, 100 + index / 30)


def replay(recording: Path, out: Path, options: list[str]) -> dict[str, float]:
    """In a process of its own; -> frames, peak memory in MB and seconds."""
    outputs = ["mcap", "ply", *(o for o, m in EXTRAS.items() if importlib.util.find_spec(m))]
    arguments = [str(recording), "--out", str(out), "--write", ",".join(outputs), *options]
    start = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *arguments], stdout=subprocess.PIPE, text=True, check=True
    )
    peak = int(done.stdout.rsplit("peak_kb", 1)[1]) / 1024
    metrics = json.loads((out / "metrics.json").read_text())
    written = {file.stem: file.stat().st_size / 1e6 for file in out.iterdir()}
    print(f"{metrics['frames']} frames: {peak:.0f} MB; files, MB: {written}", file=sys.stderr)
    return {
        "frames": metrics["frames"],
        "peak_mb": round(peak, 1),
        "seconds": round(time.monotonic() - start, 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--size", default="320x240", help="WIDTHxHEIGHT")
    parser.add_argument("--grow", type=float, default=16.0, help="MB allowed (default: 16)")
    options, others = parser.parse_known_args()
    width, height = (int(part) for part in options.size.split("x"))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for times in LENGTHS:
            path = Path(folder) / f"room_{times}"
            write_rgbd_recording(path, room(times * options.frames, (height, width)))
            rows.append(replay(path, Path(folder) / f"out_{times}", others))
    grown = rows[-1]["peak_mb"] - rows[0]["peak_mb"]
    print(json.dumps({"replays": rows, "grown_mb": round(grown, 1)}, indent=1))
    return 1 if grown > options.grow else 0


if __name__ == "__main__":
    sys.exit(main())
