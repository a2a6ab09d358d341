"""Random tensors with the same bits on every processor: numpy draws them.

torch.randn, and every initialisation by torch.nn.init, rounds differently under other vector
extensions from one and the same seed. A seed may also be a numpy Generator, to draw on from it.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

Seed = int | np.random.Generator


def normal(seed: Seed, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Standard normal values."""
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape)).to(dtype)


def uniform(seed: Seed, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Values between 0 and 1."""
    return torch.from_numpy(np.random.default_rng(seed).random(shape)).to(dtype)


def redraw(parameters: Iterable[Tensor], std: float, seed: Seed) -> None:
    """Fill parameters with normal values of a standard deviation, one after another."""
    rng = np.random.default_rng(seed)
    with torch.no_grad():
        for parameter in parameters:
            parameter.copy_(std * normal(rng, *parameter.shape))
