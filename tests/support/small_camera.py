"""The small pictures that the renderer's tests take, and the rays of their pixels."""

import numpy as np

from dyfn_worlds.render.renderer import RenderCamera

SIZE = (48, 64)


def rays(camera: RenderCamera) -> np.ndarray:
    """H x W x 3 camera rays with z = 1 through the pixel centres."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    x = (u / SIZE[1] - camera.centre[0]) / camera.focal[0]
    y = (v / SIZE[0] - camera.centre[1]) / camera.focal[1]
    return np.stack([x, y, np.ones_like(x)], axis=-1)
