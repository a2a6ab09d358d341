"""What a checkpoint holds of the optimizer and of the random generators."""

from __future__ import annotations

import json
import random
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim import Optimizer

Moments = dict[str, dict[str, Tensor]]


def moments(model: nn.Module, optimizer: Optimizer) -> Moments:
    """The optimizer's state by parameter name, so that a resumed run may freeze other parts."""
    return {
        name: dict(optimizer.state[parameter])
        for name, parameter in model.named_parameters()
        if parameter in optimizer.state
    }


def restore_moments(model: nn.Module, optimizer: Optimizer, saved: Moments) -> None:
    """Give the optimizer what `moments` took, for the parameters that it has."""
    trained = {id(p) for group in optimizer.param_groups for p in group["params"]}
    for name, parameter in model.named_parameters():
        if name in saved and id(parameter) in trained:
            optimizer.state[parameter] = {
                key: value if key == "step" else value.to(parameter.device)
                for key, value in saved[name].items()
            }


def random_state() -> dict[str, Any]:
    """Of torch's, NumPy's and Python's generators; nothing in it but tensors and plain values."""
    return {
        "torch_rng": torch.get_rng_state(),
        "numpy_rng": json.dumps(np.random.get_state(legacy=False), default=np.ndarray.tolist),
        "python_rng": random.getstate(),
    }


def restore_random_state(saved: dict[str, Any]) -> None:
    """Set the generators to what `random_state` took."""
    torch.set_rng_state(saved["torch_rng"])
    np.random.set_state(json.loads(saved["numpy_rng"]))
    version, internal, gauss = saved["python_rng"]
    random.setstate((version, tuple(internal), gauss))
