"""Makes a scene look different without moving a triangle: textures, tint, light."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from dyfn_worlds.scene.builder import fit_texture
from dyfn_worlds.scene.scene import Scene


def vary(scene: Scene, rng: np.random.Generator, pool: list[np.ndarray], swap: float) -> Scene:
    """A scene with a share `swap` of its textures exchanged for the pool's, tints and sky drawn."""
    textures = []
    for texture in scene.textures:
        # mostly black layers are glow maps whose material comes from a later stage
        swapped = rng.random() < swap or np.median(texture) < 8
        if pool and swapped:
            texture = fit_texture(pool[rng.integers(len(pool))])
        textures.append(tint(texture, rng))
    low = rng.uniform(0.5, 1.0, 3)
    sky = np.stack([low, np.clip(low * rng.uniform(0.5, 1.0) + [0, 0.05, 0.2], 0, 1)])
    return replace(scene, textures=textures, sky=sky.astype(np.float32))


def tint(texture: np.ndarray, rng: np.random.Generator, strength: float = 0.25) -> np.ndarray:
    """Random hue, saturation and gain of one texture."""
    hsv = cv2.cvtColor(texture, cv2.COLOR_RGB2HSV).astype(np.float32)
    hsv[..., 0] = (hsv[..., 0] + rng.normal(0, 60 * strength)) % 180
    hsv[..., 1] *= np.exp(rng.normal(-0.2, 2 * strength))
    hsv[..., 2] *= np.exp(rng.normal(0, strength))
    return cv2.cvtColor(np.clip(hsv, 0, 255).astype(np.uint8), cv2.COLOR_HSV2RGB)
