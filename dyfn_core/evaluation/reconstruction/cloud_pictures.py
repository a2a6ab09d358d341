"""A fused cloud and its cameras as pictures: from above and obliquely, orthographic."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dyfn_core.geometry.registration import Similarity

BACKGROUND = (24, 26, 31)
PATH = (255, 150, 40)
UP = np.array([0.0, -1.0, 0.0])  # of the first camera's optical frame, when nothing better is known
MARGIN = 0.04
CEILING = 90  # percentile of height that the view from above is cut at


def upright(poses: Sequence[Similarity | None], up: np.ndarray | None = None) -> np.ndarray:
    """3 x 3 rotation from the world to axes x right, y forward, z up, as seen by the first camera.

    up: direction in the world; None: the mean of what is up in each camera's image.
    """
    known = [pose for pose in poses if pose is not None] or [Similarity.identity()]
    mean = np.mean([pose.rotation @ UP for pose in known], axis=0) if up is None else up
    norm = np.linalg.norm(mean)
    z = mean / norm if norm > 1e-6 else known[0].rotation @ UP
    forward = known[0].rotation @ [0.0, 0.0, 1.0]
    y = forward - (forward @ z) * z
    if np.linalg.norm(y) < 1e-6:
        y = known[0].rotation @ [0.0, 1.0, 0.0]
        y = y - (y @ z) * z
    y = y / np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z])


def draw_fused(
    points: np.ndarray,
    colours: np.ndarray,
    poses: Sequence[Similarity | None] = (),
    *,
    oblique: bool = False,
    up: np.ndarray | None = None,
    size: tuple[int, int] = (480, 560),
) -> np.ndarray:
    """The cloud and the cameras' path, size[0] x size[1] x 3 uint8 RGB.

    points: N x 3; colours: N x 3 uint8. poses: camera to the same world, drawn as a line. From
    above, what is higher than nine tenths of the points is cut away, so that a ceiling does not
    hide the room. oblique: seen from behind the first camera, 35 degrees above the horizon.
    """
    picture = np.full((*size, 3), BACKGROUND, np.uint8)
    if not len(points):
        return picture
    turn = upright(poses, up)
    world = points @ turn.T
    if oblique:
        tilt = np.radians(35)
        view = np.array(
            [[1, 0, 0], [0, np.sin(tilt), np.cos(tilt)], [0, -np.cos(tilt), np.sin(tilt)]]
        )
        seen, path = world @ view.T, _path(poses) @ (view @ turn).T
    else:
        kept = world[:, 2] <= np.percentile(world[:, 2], CEILING)
        seen, colours, path = world[kept], colours[kept], _path(poses) @ turn.T
    low, high = np.percentile(seen[:, :2], [0.5, 99.5], axis=0)
    if len(path):
        low, high = np.minimum(low, path[:, :2].min(0)), np.maximum(high, path[:, :2].max(0))
    extent = np.maximum(high - low, 1e-9)
    scale = (1 - 2 * MARGIN) * min(size[1] / extent[0], size[0] / extent[1])
    middle = (low + high) / 2
    _splat(picture, _pixels(seen, middle, scale, size), seen[:, 2], colours)
    if len(path):
        _draw_path(picture, _pixels(path, middle, scale, size))
    return picture


def _pixels(
    points: np.ndarray, middle: np.ndarray, scale: float, size: tuple[int, int]
) -> np.ndarray:
    """x right, y up -> columns and rows, N x 2 int."""
    flat = (points[:, :2] - middle) * [scale, -scale] + [size[1] / 2, size[0] / 2]
    result: np.ndarray = np.floor(flat).astype(int)
    return result


def _splat(
    picture: np.ndarray, pixels: np.ndarray, height: np.ndarray, colours: np.ndarray
) -> None:
    """Points as 2 x 2 pixels, the highest in front."""
    order = np.argsort(height, kind="stable")
    for dx, dy in ((1, 1), (0, 1), (1, 0), (0, 0)):
        at = pixels[order] + [dx, dy]
        inside = ((at >= 0) & (at < [picture.shape[1], picture.shape[0]])).all(1)
        if (dx, dy) == (1, 1):
            top = np.full(picture.shape[:2], -np.inf)
        rows, columns = at[inside, 1], at[inside, 0]
        new = np.full_like(top, -np.inf)
        new[rows, columns] = height[order][inside]
        painted = np.zeros_like(picture)
        painted[rows, columns] = colours[order][inside]
        nearer = new > top
        picture[nearer], top[nearer] = painted[nearer], new[nearer]


def _path(poses: Sequence[Similarity | None]) -> np.ndarray:
    return np.array([p.translation for p in poses if p is not None]).reshape(-1, 3)


def _draw_path(picture: np.ndarray, pixels: np.ndarray) -> None:
    import cv2

    cv2.polylines(picture, [pixels[:, None].astype(np.int32)], False, PATH, 2, cv2.LINE_AA)
    cv2.circle(picture, (int(pixels[0, 0]), int(pixels[0, 1])), 5, PATH, -1, cv2.LINE_AA)
