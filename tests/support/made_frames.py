"""A small made data set in the renderer's format: textured planes with exact depth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.rendered import KINDS, encode_depth

SIZE = (72, 96)
INTRINSICS = [0.8, 0.8 * SIZE[1] / SIZE[0], 0.5, 0.5]


def made_frame(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """RGB and depth (inf where no plane is hit) of three random textured planes."""
    height, width = SIZE
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    fx, fy, cx, cy = INTRINSICS
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1)
    depth, image = np.full(SIZE, np.inf), np.full((*SIZE, 3), 200, np.uint8)
    for axis in np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.5]]):
        normal = axis + rng.normal(0, 0.1, 3)
        z = rng.uniform(1, 5) / np.where(np.abs(rays @ normal) < 1e-6, 1e-6, rays @ normal)
        hit = (z > 0.2) & (z < 60) & (z < depth)
        place = (rays * z[..., None] * 2).astype(int)
        colours = rng.integers(0, 255, (97, 3), dtype=np.uint8)
        image[hit] = colours[(place @ [3, 5, 7]) % 97][hit]
        depth[hit] = z[hit]
    return image, depth


def write_shard(
    root: Path,
    name: str,
    kind: str,
    split: str,
    frames: int,
    seed: int = 0,
    changes: dict[str, object] | None = None,
) -> Path:
    """A finished shard folder; `changes` replace entries of its meta.json."""
    folder = root / KINDS[kind] / name
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    for index in range(frames):
        image, depth = made_frame(rng)
        cv2.imwrite(
            str(folder / f"{index:05d}.jpg"), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98]
        )
        cv2.imwrite(str(folder / f"{index:05d}.png"), encode_depth(depth))
    meta = {
        "world": "made",
        "intrinsics": [INTRINSICS] * frames,
        "size": list(SIZE),
        "poses": None,
        "kind": kind,
        "split": split,
        "done": True,
        **(changes or {}),
    }
    (folder / "meta.json").write_text(json.dumps(meta))
    return folder


def write_data_set(root: Path) -> Path:
    """Frames and clips to train on, and held-out ones of both kinds."""
    write_shard(root, "a_0", "frames", "train", 8, seed=1)
    write_shard(root, "a_1", "clip", "train", 10, seed=2)
    write_shard(root, "b_0", "frames", "held_out", 3, seed=3)
    write_shard(root, "b_1", "clip", "held_out", 10, seed=4)
    return root
