"""A part of a model, compiled by torch."""

from __future__ import annotations

import torch

from dyfn_core.models.export.parts import Part, Tensors


class CompiledPart:
    """A part for fixed sizes; it is compiled when it first runs, which takes a minute or so."""

    def __init__(self, part: Part) -> None:
        """part: The part, on the device that it runs on."""
        self._inputs, self._outputs = tuple(part.inputs), tuple(part.outputs)
        self._compiled = torch.compile(part, dynamic=False)

    def run(self, tensors: Tensors) -> Tensors:
        """Named inputs -> named outputs, on the model's device."""
        found = self._compiled(*(tensors[name].clone() for name in self._inputs))
        return dict(zip(self._outputs, found, strict=True))
