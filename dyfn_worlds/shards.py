"""Renders scenes to disk: folders of JPEG colour, 16-bit PNG depth and a meta.json."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from dyfn_worlds.render.renderer import RenderCamera

DEPTH_INVALID = 0
DEPTH_INFINITE = 65535
MILLIMETRES = 1000.0


@dataclass(frozen=True)
class RenderedView:
    """image H x W x 3 uint8 RGB; depth H x W float32 metres, +inf for the sky.

    moving: H x W bool, what moves on its own, or None. record: how the view was taken.
    """

    image: np.ndarray
    depth: np.ndarray
    camera: RenderCamera
    moving: np.ndarray | None = None
    record: dict[str, object] = field(default_factory=dict)


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Metres -> uint16 millimetres; sky DEPTH_INFINITE, unknown or beyond 65.5 m DEPTH_INVALID."""
    out = np.zeros(depth.shape, np.uint16)
    known = np.isfinite(depth) & (depth > 0) & (depth < (DEPTH_INFINITE - 1) / MILLIMETRES)
    out[known] = np.maximum(np.round(depth[known] * MILLIMETRES), 1).astype(np.uint16)
    out[np.isposinf(depth)] = DEPTH_INFINITE
    return out


def write_shard(folder: Path, views: list[RenderedView], meta: dict[str, object]) -> None:
    """One folder of views, with a mask `%05d_moving.png` where something moves; meta.json is
    written last, so that a reader sees whole shards only."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, view in enumerate(views):
        image = np.ascontiguousarray(view.image[..., ::-1])
        cv2.imwrite(str(folder / f"{index:05d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        depth = encode_depth(view.depth)
        cv2.imwrite(str(folder / f"{index:05d}.png"), depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if view.moving is not None and view.moving.any():
            mask = view.moving.astype(np.uint8) * 255
            cv2.imwrite(str(folder / f"{index:05d}_moving.png"), mask)
    content = {
        **meta,
        "size": list(views[0].image.shape[:2]),
        "count": len(views),
        "intrinsics": [[*v.camera.focal, *v.camera.centre] for v in views],
        "poses": [v.camera.pose.tolist() for v in views],
        "frames": [{**v.record, "moving_share": _share(v.moving)} for v in views],
        "done": True,
    }
    partial = folder / "meta.json.part"
    partial.write_text(json.dumps(content))
    partial.rename(folder / "meta.json")


def _share(mask: np.ndarray | None) -> float:
    return 0.0 if mask is None else round(float(mask.mean()), 5)


def existing_shards(root: Path) -> set[str]:
    """Names of the finished shards under root."""
    return {p.parent.name for p in root.glob("*/*/meta.json")}


def summarise(views: Iterable[RenderedView]) -> dict[str, float]:
    """Depth quantiles in metres, for a progress line."""
    depth = np.concatenate([v.depth[::16, ::16].ravel() for v in views])
    solid = depth[np.isfinite(depth)]
    low, middle, high = np.quantile(solid, [0.05, 0.5, 0.95])
    return {"p5": float(low), "median": float(middle), "p95": float(high)}
