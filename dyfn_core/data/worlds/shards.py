"""Renders scenes to disk: folders of JPEG colour, 16-bit PNG depth and a meta.json."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.data.worlds.cameras import FreeSpace, Lens, random_path, random_view
from dyfn_core.data.worlds.renderer import Camera, Renderer
from dyfn_core.data.worlds.scene import Scene

DEPTH_INVALID = 0
DEPTH_INFINITE = 65535
MILLIMETRES = 1000.0
PROBE_SHRINK = 4


@dataclass(frozen=True)
class View:
    """image H x W x 3 uint8 RGB; depth H x W float32 metres, +inf for the sky."""

    image: np.ndarray
    depth: np.ndarray
    camera: Camera


def encode_depth(depth: np.ndarray) -> np.ndarray:
    """Metres -> uint16 millimetres; sky DEPTH_INFINITE, unknown or beyond 65.5 m DEPTH_INVALID."""
    out = np.zeros(depth.shape, np.uint16)
    known = np.isfinite(depth) & (depth > 0) & (depth < (DEPTH_INFINITE - 1) / MILLIMETRES)
    out[known] = np.maximum(np.round(depth[known] * MILLIMETRES), 1).astype(np.uint16)
    out[np.isposinf(depth)] = DEPTH_INFINITE
    return out


class Photographer:
    """Looks before it shoots: exposure from a small probe, and views not worth keeping refused."""

    def __init__(self, renderer: Renderer, scene: Scene, rng: np.random.Generator) -> None:
        self.renderer, self.rng = renderer, rng
        self.space = FreeSpace(scene)
        self.gloss = float(rng.uniform(0, 0.6))
        self.brightness = float(np.clip(rng.lognormal(np.log(95), 0.3), 45, 170))
        renderer.load(scene)

    def exposure(self, camera: Camera) -> float | None:
        """What brings the mean to this shoot's brightness; None for a view not worth keeping."""
        image, depth = self.renderer.draw(camera, 1.0, self.gloss, PROBE_SHRINK)
        solid = np.isfinite(depth)
        if solid.mean() < 0.5 or np.quantile(depth, 0.02) < 0.2:
            return None
        low, middle, high = np.quantile(depth[solid], [0.05, 0.5, 0.95])
        if middle > 25 or (high < 1.7 * low and self.rng.random() < 0.85):
            return None
        mean = max(float(image[solid].mean()), 2.0)
        contrast = image[solid].std() / mean
        if contrast < 0.08 or (contrast < 0.18 and self.rng.random() < 0.7):
            return None
        return float(np.clip((self.brightness / mean) ** 2, 0.05, 40.0))

    def frames(self, count: int) -> list[View]:
        """`count` independent views; fewer when the scene has not enough worth keeping."""
        views: list[View] = []
        for _ in range(count * 6):
            if len(views) == count:
                break
            camera = random_view(self.space, self.rng, Lens.sample(self.rng, self.renderer.size))
            exposure = self.exposure(camera)
            if exposure is not None:
                views.append(View(*self.renderer.draw(camera, exposure, self.gloss), camera))
        return views

    def clip(self, count: int, seconds: float) -> list[View]:
        """`count` consecutive views of one path, exposure following with a lag.

        Raises ValueError when no path is found on which most views are worth keeping.
        """
        for _ in range(8):
            lens = Lens.sample(self.rng, self.renderer.size)
            path = random_path(self.space, self.rng, lens, count, seconds)
            every = max(1, count // 16)
            probes = [self.exposure(camera) for camera in path[::every]]
            good = [e for e in probes if e is not None]
            if len(good) < 0.75 * len(probes):
                continue
            views, exposure = [], good[0]
            for index, camera in enumerate(path):
                exposure *= ((probes[index // every] or exposure) / exposure) ** 0.25
                views.append(View(*self.renderer.draw(camera, exposure, self.gloss), camera))
            return views
        raise ValueError("no camera path worth keeping found")


def write_shard(folder: Path, views: list[View], meta: dict[str, object]) -> None:
    """One folder of views; meta.json is written last, so that a reader sees whole shards only."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, view in enumerate(views):
        image = np.ascontiguousarray(view.image[..., ::-1])
        cv2.imwrite(str(folder / f"{index:05d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])
        depth = encode_depth(view.depth)
        cv2.imwrite(str(folder / f"{index:05d}.png"), depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    content = {
        **meta,
        "size": list(views[0].image.shape[:2]),
        "count": len(views),
        "intrinsics": [[*v.camera.focal, *v.camera.centre] for v in views],
        "poses": [v.camera.pose.tolist() for v in views],
        "done": True,
    }
    partial = folder / "meta.json.part"
    partial.write_text(json.dumps(content))
    partial.rename(folder / "meta.json")


def existing_shards(root: Path) -> set[str]:
    """Names of the finished shards under root."""
    return {p.parent.name for p in root.glob("*/*/meta.json")}


def summarise(views: Iterable[View]) -> dict[str, float]:
    """Depth quantiles in metres, for a progress line."""
    depth = np.concatenate([v.depth[::16, ::16].ravel() for v in views])
    solid = depth[np.isfinite(depth)]
    low, middle, high = np.quantile(solid, [0.05, 0.5, 0.95])
    return {"p5": float(low), "median": float(middle), "p95": float(high)}
