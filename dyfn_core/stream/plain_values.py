"""The values that make up a stream's memory <-> JSON and tensors, exactly."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

Kinds = Mapping[str, type]  # the dataclasses that may occur, by their name in a file


class PlainError(ValueError):
    """A description that is not one of ours."""


def to_plain(value: Any, tensors: dict[str, Tensor], kinds: Kinds) -> Any:
    """A value -> what JSON can say; arrays and tensors are put into `tensors` under new names.

    Raises TypeError for a type that is not of a known type.
    """
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(value)}
    if isinstance(value, (tuple, list)):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [to_plain(one, tensors, kinds) for one in value]}
    if isinstance(value, (Tensor, np.ndarray)):
        name = f"{len(tensors):04d}"
        if isinstance(value, np.ndarray):
            tensors[name] = torch.from_numpy(value.copy(order="C"))
            return {"array": name}
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {"tensor": name}
    if isinstance(value, dict):
        kind = "counter" if isinstance(value, Counter) else "dict"
        return {kind: {str(key): to_plain(one, tensors, kinds) for key, one in value.items()}}
    described = next((name for name, known in kinds.items() if known is type(value)), None)
    if is_dataclass(value) and described is not None:
        content = {f.name: to_plain(getattr(value, f.name), tensors, kinds) for f in fields(value)}
        return {"type": described, "fields": content}
    raise TypeError(f"a {type(value).__name__} is not of a known type")


def from_plain(plain: Any, tensors: dict[str, Tensor], kinds: Kinds) -> Any:
    """The inverse of to_plain. Raises PlainError."""
    if plain is None or isinstance(plain, (bool, int, float, str)):
        return plain
    if not isinstance(plain, dict):
        raise PlainError(f"unexpected {type(plain).__name__}")
    if "type" in plain:
        return _instance(plain, tensors, kinds)
    if len(plain) != 1:
        raise PlainError(f"unexpected keys {sorted(plain)}")
    ((kind, content),) = plain.items()
    if kind in ("tensor", "array"):
        if content not in tensors:
            raise PlainError(f"tensor {content!r} is missing")
        return tensors[content] if kind == "tensor" else tensors[content].numpy()
    if kind == "float":
        return float(content)
    if kind in ("tuple", "list"):
        values = [from_plain(one, tensors, kinds) for one in content]
        return tuple(values) if kind == "tuple" else values
    if kind in ("dict", "counter"):
        table = {key: from_plain(one, tensors, kinds) for key, one in content.items()}
        return Counter(table) if kind == "counter" else table
    raise PlainError(f"unknown kind {kind!r}")


def _instance(plain: dict[str, Any], tensors: dict[str, Tensor], kinds: Kinds) -> Any:
    if plain["type"] not in kinds:
        raise PlainError(f"unknown type {plain['type']!r}")
    kind = kinds[plain["type"]]
    content = {name: from_plain(value, tensors, kinds) for name, value in plain["fields"].items()}
    expected = {f.name for f in fields(kind)}
    # A file from before a field was added has its default.
    needed = {f.name for f in fields(kind) if f.default is f.default_factory is MISSING}
    if not needed <= set(content) <= expected:
        raise PlainError(f"{plain['type']} has {sorted(content)}, expected {sorted(expected)}")
    return kind(**content)
