"""Sentences for what pydantic finds wrong with a config, and the nearest name of an unknown key."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator
from typing import Any, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model


def describe(error: ValidationError, kind: type[BaseModel]) -> list[str]:
    """One sentence for each problem that was found in settings of this kind."""
    return [_sentence(problem, kind) for problem in error.errors()]


def check_fields(value: dict[str, Any], described: type) -> dict[str, Any]:
    """The value itself if a dataclass can be made of it.

    Raises ValueError that names unknown keys, values of a wrong type, and what the dataclass
    itself refuses.
    """
    hints = get_type_hints(described)
    fields: dict[str, Any] = {
        field.name: (hints[field.name], field.default) for field in dataclasses.fields(described)
    }
    model = create_model(described.__name__, __config__=ConfigDict(extra="forbid"), **fields)
    try:
        described(**model.model_validate(value).model_dump())
    except ValidationError as error:
        raise ValueError("; ".join(describe(error, model))) from error
    return value


def _sentence(problem: Any, kind: type[BaseModel]) -> str:
    where = ".".join(str(part) for part in problem["loc"])
    if problem["type"] == "extra_forbidden":
        return f"unknown key {where!r}{_nearest(problem['loc'], kind)}"
    if problem["type"] == "missing":
        return f"key {where!r} is missing"
    return f"{where}: {problem['msg']} (got {problem['input']!r})"


def _nearest(place: tuple[Any, ...], kind: type[BaseModel]) -> str:
    """ ", did you mean ...?": the same name of another level, else a similar one of this."""
    level: type[BaseModel] | None = kind
    for part in place[:-1]:
        if level is not None and part in level.model_fields:
            level = next(_models(level.model_fields[part].annotation), None)
    own = list(level.model_fields) if level is not None else []
    found = [name for name in _paths(kind) if name.rpartition(".")[2] == place[-1]]
    found += difflib.get_close_matches(str(place[-1]), own, n=1)
    return f", did you mean {found[0]!r}?" if found else ""


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that an annotation such as tuple[Model, ...] speaks of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _paths(kind: type[BaseModel], prefix: str = "") -> Iterator[str]:
    for name, field in kind.model_fields.items():
        yield prefix + name
        for model in _models(field.annotation):
            yield from _paths(model, f"{prefix}{name}.")
