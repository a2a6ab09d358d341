"""A moving average of the parameters that are trained."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from torch import Tensor, nn


class Ema:
    """Averages of a model's trainable parameters; the decay warms up with the updates."""

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.decay, self.updates = decay, 0
        self.parameters = {n: p for n, p in model.named_parameters() if p.requires_grad}
        self.averages = {name: value.detach().clone() for name, value in self.parameters.items()}

    @torch.no_grad()
    def update(self) -> None:
        self.updates += 1
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        for name, value in self.parameters.items():
            self.averages[name].lerp_(value.detach(), 1 - decay)

    @contextlib.contextmanager
    def applied(self) -> Iterator[None]:
        """Inside, the model has the averages; afterwards its own parameters again."""
        own = {name: value.detach().clone() for name, value in self.parameters.items()}
        self._write(self.averages)
        try:
            yield
        finally:
            self._write(own)

    @torch.no_grad()
    def _write(self, values: dict[str, Tensor]) -> None:
        for name, value in values.items():
            self.parameters[name].copy_(value)

    def state_dict(self) -> dict[str, object]:
        return {"updates": self.updates, "averages": self.averages}

    def load_state_dict(self, state: dict[str, object]) -> None:
        """Take over the averages of parameters that are still trained.

        A parameter that this run trains and the saved one did not starts from its present value.
        """
        averages = state["averages"]
        if not isinstance(averages, dict):
            raise ValueError("the checkpoint holds no averaged parameters")
        self.updates = int(str(state["updates"]))
        for name, own in self.averages.items():
            own.copy_(averages.get(name, self.parameters[name].detach()))
