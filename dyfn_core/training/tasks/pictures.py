"""Strips of images for TensorBoard and the run folder."""

from __future__ import annotations

import cv2
import numpy as np
from torch import Tensor

from dyfn_core.data.clips import ClipBatch


def picture_rows(batch: ClipBatch, depth: Tensor, count: int = 6) -> np.ndarray:
    """Image, true depth and predicted depth (B x h x w) of the first frames, one column each."""
    columns = []
    for index in range(min(count, len(depth))):
        image = batch.image[index, 0].permute(1, 2, 0).cpu().numpy()
        size = (image.shape[1], image.shape[0])
        true, ours = batch.depth[index, 0].cpu().numpy(), depth[index].float().cpu().numpy()
        columns.append(np.vstack([image, coloured_depth(true, size), coloured_depth(ours, size)]))
    return np.hstack(columns)


def coloured_depth(depth: np.ndarray, size: tuple[int, int] | None = None) -> np.ndarray:
    """H x W depth -> RGB, near red, far blue, invalid black; resized to (width, height)."""
    valid = np.isfinite(depth) & (depth > 0)
    near = np.zeros_like(depth)
    near[valid] = 1 / depth[valid]
    low, high = np.percentile(near[valid], [2, 98]) if valid.any() else (0.0, 1.0)
    scaled = np.clip((near - low) / max(high - low, 1e-9), 0, 1)
    coloured = cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[~valid] = 0
    rgb = np.ascontiguousarray(coloured[..., ::-1])
    return rgb if size is None else cv2.resize(rgb, size, interpolation=cv2.INTER_NEAREST)
