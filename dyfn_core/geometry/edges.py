"""Depth discontinuities: where a depth map's pixels hang between two surfaces."""

from __future__ import annotations

import numpy as np


def flying_pixels(depth: np.ndarray, valid: np.ndarray, share: float) -> np.ndarray:
    """H x W bool: pixels whose depth differs from a valid 4-neighbour's by more than a share.

    depth: H x W, positive where valid. valid: H x W bool. share: of the nearer one's depth, > 0.
    A smooth depth map of two surfaces has a ramp between them; both ends and all between are
    marked where it is steep. Pixels that are not valid neither are marked nor mark others.
    """
    marked = np.zeros(depth.shape, bool)
    for one, other in (
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
        ((slice(1, None), slice(None)), (slice(None, -1), slice(None))),
    ):
        with np.errstate(invalid="ignore", over="ignore"):
            near = np.minimum(depth[one], depth[other])
            steep = np.abs(depth[one] - depth[other]) > share * near
        steep &= valid[one] & valid[other]
        marked[one] |= steep
        marked[other] |= steep
    return marked
