"""Folders of links: the first two thirds of every recording to train on, the last third held back.

    python benchmarks/split_recordings.py RECORDINGS data/real

RECORDINGS holds folders with rgb/, depth/, K.txt and perhaps poses.txt; data/real gets train/ and
held/ with the same folders. What is there already is made anew.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

HELD_BACK = 3  # one frame in so many, the last ones


def split(folder: Path, out: Path) -> tuple[int, int]:
    """Frames to train on and held back, of one recording."""
    frames = sorted((folder / "rgb").glob("*.jpg"))
    file = folder / "poses.txt"
    lines = file.read_text().splitlines() if file.exists() else []
    poses = [line for line in lines if line.strip()]
    cut = max(1, len(frames) - len(frames) // HELD_BACK) if len(frames) != 2 else 1
    for name, part in (("train", slice(None, cut)), ("held", slice(cut, None))):
        to = out / name / folder.name
        shutil.rmtree(to, ignore_errors=True)
        for kind in ("rgb", "depth"):
            (to / kind).mkdir(parents=True)
        for frame in frames[part]:
            depth = folder / "depth" / f"{frame.stem}.png"
            (to / "rgb" / frame.name).symlink_to(frame.resolve())
            (to / "depth" / depth.name).symlink_to(depth.resolve())
        shutil.copy(folder / "K.txt", to / "K.txt")
        if len(poses) == len(frames):
            (to / "poses.txt").write_text("\n".join(poses[part]) + "\n")
    return cut, len(frames) - cut


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recordings", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    for folder in sorted(p for p in options.recordings.iterdir() if (p / "rgb").is_dir()):
        train, held = split(folder, options.out)
        print(f"{folder.name}: {train} to train on, {held} held back")


if __name__ == "__main__":
    main()
