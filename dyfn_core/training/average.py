"""Weights of several runs averaged: often better than each of them (Wortsman et al., 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from dyfn_core.models.base import GeometryModel
from dyfn_core.models.checkpoints import Checkpoint, build_model, read_checkpoint

DYFN = "stabilizer."


def average(paths: Sequence[Path], shares: Sequence[float]) -> GeometryModel:
    """The weighted mean of checkpoints of one architecture that come from a common start.

    shares: one of each checkpoint, positive; they are divided by their sum. Means are taken in
    float64. DyFN is the first checkpoint's: recurrences of different runs have no common start,
    and the mean of two is neither.

    Raises ValueError when the numbers of paths and shares differ, a share is not positive, or the
    bases are of different architecture (naming file and tensor); FileNotFoundError and
    CheckpointError as read_checkpoint.
    """
    if len(paths) < 2 or len(paths) != len(shares):
        raise ValueError(
            f"two or more checkpoints and a share of each are needed, got {len(paths)} and "
            f"{len(shares)}"
        )
    if not all(0 < share < float("inf") for share in shares):
        raise ValueError(f"shares must be positive, got {list(shares)}")
    checkpoints = [read_checkpoint(path) for path in paths]
    first = checkpoints[0]
    for path, other in zip(paths[1:], checkpoints[1:], strict=True):
        _check_alike(paths[0], first, path, other)
    total = sum(shares)
    weights = {
        name: value
        if name.startswith(DYFN) or not value.is_floating_point()
        else _mean([c.weights[name] for c in checkpoints], [share / total for share in shares])
        for name, value in first.weights.items()
    }
    mixed = Checkpoint(first.config, weights, {}, first.official)
    return build_model(mixed, " and ".join(str(path) for path in paths))


def _mean(tensors: list[Tensor], shares: list[float]) -> Tensor:
    parts = [share * tensor.double() for tensor, share in zip(tensors, shares, strict=True)]
    return torch.stack(parts).sum(0).to(tensors[0].dtype)


def _check_alike(path: Path, first: Checkpoint, other_path: Path, other: Checkpoint) -> None:
    shapes, other_shapes = _base_shapes(first), _base_shapes(other)
    for name in sorted(shapes.keys() | other_shapes.keys()):
        ours, theirs = shapes.get(name, "absent"), other_shapes.get(name, "absent")
        if ours != theirs:
            raise ValueError(
                f"{path} and {other_path} are not of one architecture: {name} is {ours} in the "
                f"first and {theirs} in the second"
            )


def _base_shapes(checkpoint: Checkpoint) -> dict[str, tuple[int, ...]]:
    return {
        name: tuple(value.shape)
        for name, value in checkpoint.weights.items()
        if not name.startswith(DYFN)
    }
