"""A model whose parts run in another library than torch."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, Protocol

import torch
from torch import Tensor

from dyfn_core.models.base import Affine, GeometryModel, Latent, Prepared, plane
from dyfn_core.models.export.parts import (
    IMAGE,
    LATENT,
    NEXT,
    STABILIZED,
    Part,
    Tensors,
    affine_from,
    decode_part,
    encode_part,
    latent_from,
    latent_tensors,
    stabilize_part,
    state_from,
    state_tensors,
)
from dyfn_core.models.identity import model_fingerprint
from dyfn_core.prediction import StreamState

SHARED = (
    *("mask_threshold", "quantity", "stabilizer_pool", "token_cell"),
    *("has_normals", "knows_metres", "preparation"),
)


class Runner(Protocol):
    """A part that is ready to run."""

    def run(self, tensors: Tensors) -> Tensors:
        """Named inputs, what is not for the part is left out -> named outputs."""


# A part and what decides it, as JSON-able values -> ready to run.
MakeRunner = Callable[[Part, dict[str, Any]], Runner]


class BackedModel(GeometryModel):
    """The same model with encoder, DyFN and decoder in another library.

    A part is made ready when the first image of its size comes. Images of a batch run one after
    the other: a stream's bits do not depend on the streams beside it.

    Attributes:
        plain: The model in torch: weights, config, preparation of images.
        backend: The library's name.
    """

    def __init__(self, plain: GeometryModel, backend: str, make: MakeRunner) -> None:
        """Wrap a model; nothing is made ready yet.

        Args:
            plain: The model, in eval mode, float32.
            backend: The library's name.
            make: Makes a part ready to run.
        """
        super().__init__()
        self._plain = plain
        self.stabilizer = plain.stabilizer
        self.backend = backend
        for name in SHARED:
            setattr(self, name, getattr(plain, name))
        self._make = make
        self._runners: dict[Hashable, Runner] = {}
        self._first: dict[tuple[int, ...], Tensors] = {}  # states of first frames, by latent
        self._lock = threading.Lock()
        self.eval()

    @classmethod
    def from_config(cls, config: dict[str, Any]) -> GeometryModel:
        """A config is that of a model in torch: raises TypeError."""
        raise TypeError("load_model(name, backend=...) gives a backend's model, no config does")

    @property
    def plain(self) -> GeometryModel:
        """See GeometryModel."""
        return self._plain

    @property
    def config(self) -> dict[str, Any]:
        """See GeometryModel."""
        return self._plain.config

    @property
    def latent_channels(self) -> int:
        """See GeometryModel."""
        return self._plain.latent_channels

    def prepare(self, image: Tensor, num_tokens: int | None = None) -> Prepared:
        """See GeometryModel; in torch."""
        return self._plain.prepare(image, num_tokens)

    def stabilized_size(self, network_size: tuple[int, int]) -> tuple[int, int]:
        """See GeometryModel."""
        return self._plain.stabilized_size(network_size)

    def metres_of_focal(self, network_size: tuple[int, int]) -> tuple[float, float] | None:
        """See GeometryModel."""
        return self._plain.metres_of_focal(network_size)

    def encode_prepared(self, prepared: Prepared) -> Latent:
        """See GeometryModel."""
        one = replace(prepared, pixels=prepared.pixels[:1])
        runner = self._runner("encode", partial(encode_part, self._plain, one), plane(one.pixels))
        found = self._stacked([runner.run({IMAGE: row}) for row in prepared.pixels.split(1)])
        like = Latent(found[LATENT], prepared.image_size, prepared.network_size)
        return latent_from(found, like)

    def stabilize(
        self, features: Tensor, state: StreamState | None
    ) -> tuple[Tensor, StreamState | None]:
        """See GeometryModel; a stabilizer in the place of the model's own runs in torch."""
        own = self._plain.stabilizer
        if own is None or self.stabilizer is not own:
            return super().stabilize(features, state)
        first = self._first_state(features)
        before = [first] * len(features)
        if state is not None:
            before = [state_tensors(one) for one in state.unbind()]
        _check_states(before, first, len(features))
        shape = tuple(features.shape[1:])
        runner = self._runner("stabilize", partial(stabilize_part, own, features[:1]), shape)
        rows = [
            runner.run({LATENT: one, **known})
            for one, known in zip(features.split(1), before, strict=True)
        ]
        found = self._stacked(rows)
        return found[STABILIZED], state_from(found, NEXT)

    def decode(self, latent: Latent) -> Affine:
        """See GeometryModel."""
        return self._decode(latent, normals=False)

    def decode_all(self, latent: Latent) -> Affine:
        """See GeometryModel."""
        return self._decode(latent, normals=self.has_normals)

    def _decode(self, latent: Latent, normals: bool) -> Affine:
        one = latent.entry(0)
        shape = tuple(one.features.shape[1:])
        runner = self._runner(
            "decode",
            partial(decode_part, self._plain, one, normals),
            (*shape, *one.image_size, *one.network_size, int(normals)),
        )
        rows = [runner.run(latent_tensors(latent.entry(i))) for i in range(len(latent.features))]
        return affine_from(self._stacked(rows), self.metres_of_focal(latent.network_size))

    def _first_state(self, features: Tensor) -> Tensors:
        """What a stream's state is before its first frame, for a latent of this shape."""
        shape = tuple(features.shape[1:])
        if shape not in self._first:
            assert self._plain.stabilizer is not None
            _, state = self._plain.stabilizer(features[:1], None)
            self._first[shape] = state_tensors(state.without_history())
        return self._first[shape]

    def _stacked(self, rows: Sequence[Tensors]) -> Tensors:
        """The rows of a batch, on the model's device."""
        device = self.device
        return {name: torch.cat([row[name] for row in rows]).to(device) for name in rows[0]}

    def _runner(self, name: str, part: Callable[[], Part], sizes: tuple[int, ...]) -> Runner:
        """A part for these sizes and for as many threads as torch computes with now."""
        key = (name, sizes, torch.get_num_threads())
        with self._lock:
            if key not in self._runners:
                decided_by = {"part": name, "sizes": list(sizes), **self._weights}
                self._runners[key] = self._make(part(), decided_by)
            return self._runners[key]

    @cached_property
    def _weights(self) -> dict[str, Any]:
        return {"type": self._plain.config["type"], "weights": model_fingerprint(self._plain)}


def _check_states(before: Sequence[Tensors], first: Tensors, count: int) -> None:
    shapes = [{name: tuple(value.shape) for name, value in one.items()} for one in (first, *before)]
    expected, *found = shapes
    if len(found) != count or any(one != expected for one in found):
        raise ValueError(
            f"the state is of {len(found)} streams and the shapes {found[:1]}, this batch needs "
            f"{count} and {expected}: another image size, batch or model; start the stream anew "
            "with state=None"
        )
