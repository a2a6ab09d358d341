"""Folders of rendered RGB-D frames and clips: what the renderer writes and training reads.

A root holds `frames/` and `clips/`, each with one folder per shard: `meta.json`, `%05d.jpg`
(RGB) and `%05d.png` (uint16 depth along the optical axis in millimetres, 0 = invalid,
65535 = infinite). meta.json is written last, so a folder without it is still being rendered.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from dyfn_core.data.frames import FrameError, RgbdFrame

DEPTH_UNIT = 1000.0  # stored values per metre
INFINITE = 65535
KINDS = {"frames": "frames", "clip": "clips"}  # kind -> sub-folder of the root
SPLITS = ("train", "held_out")


@dataclass(frozen=True)
class Shard:
    """One finished folder: independent views ("frames") or one camera path ("clip").

    intrinsics: N x 4 float32, normalised fx, fy, cx, cy. poses: N x 4 x 4, camera to world,
    optical axes, or None.
    """

    folder: Path
    world: str
    kind: str
    split: str
    intrinsics: np.ndarray
    poses: np.ndarray | None

    def __len__(self) -> int:
        return len(self.intrinsics)

    @property
    def name(self) -> str:
        """The folder."""
        return str(self.folder)

    def read(self, index: int) -> RgbdFrame:
        """One frame. Raises FrameError naming the file when it is absent or damaged."""
        image = _read(self.folder / f"{index:05d}.jpg", cv2.IMREAD_COLOR)
        stored = _read(self.folder / f"{index:05d}.png", cv2.IMREAD_UNCHANGED)
        if stored.dtype != np.uint16 or stored.shape != image.shape[:2]:
            raise FrameError(
                f"{self.folder}/{index:05d}.png: expected uint16 of {image.shape[:2]}, "
                f"got {stored.dtype} of {stored.shape}"
            )
        return RgbdFrame(
            cv2.cvtColor(image, cv2.COLOR_BGR2RGB),
            decode_depth(stored),
            self.intrinsics[index],
            None if self.poses is None else self.poses[index],
        )


def decode_depth(stored: np.ndarray) -> np.ndarray:
    """uint16 millimetres -> float32 metres; 0 becomes NaN and 65535 becomes inf."""
    depth = stored.astype(np.float32) / DEPTH_UNIT
    depth[stored == 0] = np.nan
    depth[stored == INFINITE] = np.inf
    return depth


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """float metres (inf: sky, NaN: invalid) -> uint16 as stored; the inverse of decode_depth."""
    finite = np.isfinite(depth)
    stored = np.where(finite, np.round(np.where(finite, depth, 0) * DEPTH_UNIT), 0)
    stored = np.clip(stored, 0, INFINITE - 1).astype(np.uint16)
    stored[np.isposinf(depth)] = INFINITE
    return stored


def list_shards(root: Path, kind: str, split: str) -> list[Shard]:
    """The finished shards of one kind ("frames" or "clip") and split, sorted by name.

    Raises ValueError on an unknown kind or split, or a meta.json that lacks something.
    """
    if kind not in KINDS or split not in SPLITS:
        raise ValueError(
            f"expected a kind of {list(KINDS)} and a split of {SPLITS}, got {kind!r}, {split!r}"
        )
    metas = sorted((root / KINDS[kind]).glob("*/meta.json"))
    shards = [read_shard(meta.parent) for meta in metas]
    return [shard for shard in shards if shard.split == split and len(shard) > 0]


def read_shard(folder: Path) -> Shard:
    """The shard in a folder. Raises ValueError naming what its meta.json lacks."""
    path = folder / "meta.json"
    try:
        meta: dict[str, Any] = json.loads(path.read_text())
        intrinsics = np.asarray(meta["intrinsics"], np.float32).reshape(-1, 4)
        poses = meta.get("poses")
        kind, split, world = meta["kind"], meta["split"], meta["world"]
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not the description of a rendered shard: {error!r}") from error
    if kind not in KINDS or split not in SPLITS:
        raise ValueError(f"{path}: kind {kind!r} or split {split!r} is unknown")
    if poses is not None and len(poses) != len(intrinsics):
        raise ValueError(f"{path}: {len(poses)} poses but {len(intrinsics)} intrinsics")
    paths = None if poses is None else np.asarray(poses, np.float64).reshape(-1, 4, 4)
    return Shard(folder, world, kind, split, intrinsics, paths)


def _read(path: Path, flags: int) -> np.ndarray:
    image = cv2.imread(str(path), flags)
    if image is None:
        raise FrameError(f"{path}: no such image, or a damaged one")
    return image
