"""Pictures that show nothing, and what else makes a picture unusable."""

from __future__ import annotations

import math

import cv2
import numpy as np

BLANK = "the picture shows nothing (covered lens, flash, darkness)"
FROZEN = "the camera is frozen, every picture has the same bytes"
CONTRAST = 3.0  # grey levels; the darkest of 849 photographs has 11
FROZEN_AFTER = 1.5  # seconds
_SIZE = (32, 24)  # width, height of the small picture
_BLOCKS = (4, 4)  # down and across
_FEWEST = 5  # blocks that must show something
_NOISE = 3.0  # standard deviations of what noise alone leaves in the small picture
_LOUDEST = 128.0  # grey levels; no noise is louder


def _smooth() -> tuple[np.ndarray, np.ndarray]:
    """The polynomials up to degree 4 over the small picture, and their least squares."""
    down, across = np.mgrid[-1 : 1 : _SIZE[1] * 1j, -1 : 1 : _SIZE[0] * 1j]
    powers = [across**i * down**j for i in range(5) for j in range(5 - i)]
    basis = np.stack(powers, -1).reshape(_SIZE[0] * _SIZE[1], -1)
    return basis, np.linalg.pinv(basis)


_BASIS, _FIT = _smooth()
_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


def contrast(image: np.ndarray) -> float:
    """Grey levels of structure in the fifth of 16 blocks, best first; 0 where noise explains it.

    A smooth course of brightness over the whole picture (a vignette, light that leaks past a
    cover) is no structure: the best polynomial of degree 4 is taken off. Each block's standard
    deviation must be above three times that of the noise, which is estimated by Immerkaer's
    Laplacian (Fast noise variance estimation, 1996).

    Args:
        image: H x W x 3 uint8 RGB, any size.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, _SIZE, interpolation=cv2.INTER_AREA).astype(np.float64).reshape(-1)
    rest = (small - _BASIS @ (_FIT @ small)).reshape(
        _BLOCKS[0], _SIZE[1] // _BLOCKS[0], _BLOCKS[1], _SIZE[0] // _BLOCKS[1]
    )
    levels = np.sort(rest.std(axis=(1, 3)).reshape(-1))[::-1]
    found = float(levels[_FEWEST - 1])
    averaged = grey.size / (_SIZE[0] * _SIZE[1])
    left = _NOISE / math.sqrt(averaged)  # of the noise, in the small picture
    if averaged < 16 or found > left * _LOUDEST:  # in few pixels structure looks like noise
        return found
    return 0.0 if found < left * _noise(grey) else found


def _noise(grey: np.ndarray) -> float:
    """Standard deviation of white noise, grey levels."""
    rough = np.abs(cv2.filter2D(grey, cv2.CV_32F, _LAPLACIAN)).mean()
    return float(rough) * math.sqrt(math.pi / 2) / 6
