"""Renders bags/demo: a walk through a furnished room, with exact depth and poses.

    python bags/make_demo.py --assets FOLDER_WITH/BlendSwap-CC-0.sh3f --out bags/demo

Only the CC0 furniture library and this project's own procedural materials go into it. Its seed
lies outside of what dyfn-worlds uses, so no training run sees this room.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_worlds.camera.photographer import Photographer
from dyfn_worlds.render.renderer import Renderer
from dyfn_worlds.rooms.furniture import Showroom
from dyfn_worlds.rooms.rooms import furnished_room
from dyfn_worlds.shards import RenderedView

LIBRARY = "BlendSwap-CC-0.sh3f"
SIZE = (240, 320)
FPS = 15.0
FIRST_STAMP = 1_700_000_000.0


def render(assets: Path, seed: int, count: int) -> list[RenderedView]:
    """The demo's views. Raises FileNotFoundError when the furniture library is not there."""
    library = next(iter(sorted(assets.rglob(LIBRARY))), None)
    if library is None:
        raise FileNotFoundError(f"{assets}: no {LIBRARY} below it (Debian: sweethome3d-furniture)")
    rng = np.random.default_rng([seed, 0xDE30])
    scene = furnished_room(rng, Showroom([library]))
    return Photographer(Renderer(SIZE), scene, rng).clip(count, count / FPS)


def frames(views: list[RenderedView]) -> Iterator[FrameToRecord]:
    height, width = SIZE
    for index, view in enumerate(views):
        (fx, fy), (cx, cy) = view.camera.focal, view.camera.centre
        # normalised coordinates put pixel centres at (i + 0.5) / N, ROS puts them at i
        matrix = np.array(
            [[fx * width, 0, cx * width - 0.5], [0, fy * height, cy * height - 0.5], [0, 0, 1]]
        )
        stamp = FIRST_STAMP + index / FPS
        yield FrameToRecord(view.image, view.depth, matrix, view.camera.pose, stamp)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--assets", type=Path, required=True)
    parser.add_argument("--out", type=Path, default=Path("bags/demo"))
    parser.add_argument("--seed", type=int, default=27)
    parser.add_argument("--frames", type=int, default=180)
    options = parser.parse_args()
    views = render(options.assets, options.seed, options.frames)
    count = write_rgbd_recording(options.out, frames(views), storage="mcap", overwrite=True)
    print(f"{options.out}: {count} frames")


if __name__ == "__main__":
    main()
