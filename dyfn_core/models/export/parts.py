"""The three parts of the pure step (image, state) -> (points, mask, state), with named tensors.

    encode:    image -> latent (, summary)
    stabilize: latent, state -> stabilized, next state
    decode:    latent or stabilized (, summary) -> points, mask (, metric_scale, normal);
               or depth, mask; or disparity

What is not a tensor (sizes, the view plane) is a constant of a part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import cached_property

import torch
from torch import Tensor, nn

from dyfn_core.models.base import (
    Affine,
    AffineDepth,
    AffineDisparity,
    AffinePoints,
    GeometryModel,
    Latent,
    Prepared,
)
from dyfn_core.models.dyfn import DyFN
from dyfn_core.prediction import StreamState

IMAGE, LATENT, SUMMARY, STABILIZED = "image", "latent", "summary", "stabilized"
NEXT = "next_"  # before the names of the state that comes out
STATE = tuple(field.name for field in fields(StreamState))
POINTS = tuple(field.name for field in fields(AffinePoints))

NAMES = {IMAGE, LATENT, SUMMARY, STABILIZED, *STATE, *POINTS, "depth", "disparity"}

Tensors = dict[str, Tensor]


class Part(nn.Module):
    """Named tensors in, named tensors out.

    inputs, outputs: examples, by name, in the order of forward's arguments and results; the outputs
    are computed when they are asked for.
    """

    def __init__(
        self, module: nn.Module, step: Callable[[Tensors], Tensors], inputs: Tensors
    ) -> None:
        """module: has the parameters. step: what the part does with named tensors."""
        super().__init__()
        self.module, self.step, self.inputs = module, step, inputs

    @cached_property
    def outputs(self) -> Tensors:
        """See the class."""
        with torch.inference_mode():
            return self.step(self.inputs)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """See `inputs` and `outputs`."""
        return tuple(self.step(dict(zip(self.inputs, inputs, strict=True))).values())


def encode_part(model: GeometryModel, prepared: Prepared) -> Part:
    """The encoder, for images as `prepare` gives them.

    prepared: of an image of the size that the part is for, a batch of one.
    """

    def step(inputs: Tensors) -> Tensors:
        return latent_tensors(model.encode_prepared(replace(prepared, pixels=inputs[IMAGE])))

    return Part(model, step, {IMAGE: prepared.pixels})


def stabilize_part(stabilizer: DyFN, features: Tensor) -> Part:
    """DyFN on a latent of the shape of `features`. A first frame's state: see StreamState."""

    def step(inputs: Tensors) -> Tensors:
        changed, state = stabilizer(inputs[LATENT], state_from(inputs))
        after = {NEXT + name: value for name, value in state_tensors(state).items()}
        return {STABILIZED: changed, **after}

    with torch.inference_mode():
        _, state = stabilizer(features, None)
    return Part(stabilizer, step, {LATENT: features, **state_tensors(state.without_history())})


def decode_part(model: GeometryModel, latent: Latent, normals: bool = False) -> Part:
    """The decoder, for latents of the shape and the sizes of `latent`.

    normals: with the normals of models that have them.
    """
    decode = model.decode_all if normals else model.decode

    def step(inputs: Tensors) -> Tensors:
        return affine_tensors(decode(latent_from(inputs, latent)))

    return Part(model, step, latent_tensors(latent))


def latent_tensors(latent: Latent) -> Tensors:
    """The tensors of a latent, by name."""
    summary = {} if latent.summary is None else {SUMMARY: latent.summary}
    return {LATENT: latent.features, **summary}


def latent_from(tensors: Mapping[str, Tensor], like: Latent) -> Latent:
    """The inverse of latent_tensors; like: has the sizes."""
    return replace(like, features=tensors[LATENT], summary=tensors.get(SUMMARY))


def state_tensors(state: StreamState) -> Tensors:
    """What a state is made of, by name."""
    every = {name: getattr(state, name) for name in STATE}
    return {name: value for name, value in every.items() if value is not None}


def state_from(tensors: Mapping[str, Tensor], prefix: str = "") -> StreamState:
    """The inverse of state_tensors, from names that begin with a prefix."""
    return StreamState(
        **{name: tensors[prefix + name] for name in STATE if prefix + name in tensors}
    )


def affine_tensors(affine: Affine) -> Tensors:
    """What a decoder gives, by name."""
    if isinstance(affine, AffinePoints):
        every = {name: getattr(affine, name) for name in POINTS}
        return {name: value for name, value in every.items() if value is not None}
    if isinstance(affine, AffineDepth):
        return {"depth": affine.depth, "mask": affine.mask}
    return {"disparity": affine.disparity}


def affine_from(
    tensors: Mapping[str, Tensor], metres_of_focal: tuple[float, float] | None = None
) -> Affine:
    """The inverse of affine_tensors; metres_of_focal: see AffineDepth."""
    if "points" in tensors:
        return AffinePoints(**{name: tensors[name] for name in POINTS if name in tensors})
    if "depth" in tensors:
        return AffineDepth(tensors["depth"], tensors["mask"], metres_of_focal)
    return AffineDisparity(tensors["disparity"])
