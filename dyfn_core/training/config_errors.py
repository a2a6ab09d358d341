"""Sentences for what pydantic finds wrong with a config, and the nearest name of an unknown key."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Iterator, Mapping
from typing import Any, get_args, get_type_hints

from pydantic import BaseModel, ConfigDict, ValidationError, create_model
from pydantic.fields import FieldInfo

KIND = "kind"  # the key that tells the models of a union apart
RENAMED = {  # settings of earlier versions
    "stabilizer": "dyfn",
    "summary_draws": "method.gru_input_draws",
    "disparity_align_weight": "method.objective.align_first_weight",
}


def describe(error: ValidationError, kind: type[BaseModel], values: Any = None) -> list[str]:
    """Say what is wrong with settings.

    Args:
        error: What pydantic found.
        kind: The model that was made of the settings.
        values: The settings themselves; their `kind` keys tell which names there are.

    Returns:
        One sentence for each problem.
    """
    return [_sentence(problem, kind, values) for problem in error.errors()]


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


def _sentence(problem: Any, kind: type[BaseModel], values: Any) -> str:
    place, level = _walk(problem["loc"], kind)
    where = ".".join(map(str, place))
    if problem["type"] == "extra_forbidden":
        return f"unknown key {where!r}{_nearest(place, level, kind, values)}"
    if problem["type"] == "missing":
        return f"key {where!r} is missing"
    if problem["type"] in ("union_tag_not_found", "union_tag_invalid"):
        assert level is not None
        annotation = level.model_fields[place[-1]].annotation
        tags = [tag for model in _models(annotation) for tag in _tags(model)]
        found = problem["ctx"].get("tag")
        told = "key is missing" if found is None else f"{found!r} is unknown"
        return f"{where}.{KIND}: {told}, expected one of {tags}"
    where = f"{where}: " if where else ""
    return f"{where}{problem['msg']} (got {problem['input']!r})"


def _walk(loc: tuple[Any, ...], kind: type[BaseModel]) -> tuple[list[Any], type[BaseModel] | None]:
    """The place without the tags that pydantic puts in behind unions; the model it is in."""
    place: list[Any] = []
    level: type[BaseModel] | None = kind
    tags: dict[str, type[BaseModel]] = {}
    for index, part in enumerate(loc):
        if part in tags:
            level, tags = tags[part], {}
            continue
        place.append(part)
        if index == len(loc) - 1:
            break
        if isinstance(part, str):
            field = level.model_fields.get(part) if level is not None else None
            models = list(_models(field.annotation)) if field is not None else []
            tags = {tag: model for model in models for tag in _tags(model)}
            level = models[0] if models else None
    return place, level


def _nearest(
    place: list[Any], level: type[BaseModel] | None, kind: type[BaseModel], values: Any
) -> str:
    """ ", did you mean ...?": the same name of another level, else a similar one of this."""
    own = list(level.model_fields) if level is not None else []
    paths = list(_paths(kind, values))
    if (now := RENAMED.get(str(place[-1]))) in paths:
        return f", it is now {now!r}"
    found = [path for path in paths if path.rpartition(".")[2] == place[-1]]
    prefix = "".join(f"{part}." for part in place[:-1])
    found += [prefix + name for name in difflib.get_close_matches(str(place[-1]), own, n=1)]
    if not found:
        ends = {path.rpartition(".")[2]: path for path in paths}
        found = [ends[name] for name in difflib.get_close_matches(str(place[-1]), ends, n=1)]
    return f", did you mean {found[0]!r}?" if found else ""


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that an annotation such as tuple[Model, ...] speaks of."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for argument in get_args(annotation):
        yield from _models(argument)


def _tags(model: type[BaseModel]) -> tuple[str, ...]:
    """What the `kind` of a model may be, if it is one of a union."""
    field = model.model_fields.get(KIND)
    return get_args(field.annotation) if field is not None else ()


def _chosen(field: FieldInfo, values: Any) -> list[type[BaseModel]]:
    """The models of a field; of a union's the one that the settings choose, if they do."""
    models = list(_models(field.annotation))
    tag = values.get(KIND) if isinstance(values, Mapping) else None
    return [model for model in models if tag in _tags(model)] or models


def _paths(kind: type[BaseModel], values: Any = None, prefix: str = "") -> Iterator[str]:
    for name, field in kind.model_fields.items():
        yield prefix + name
        own = values.get(name) if isinstance(values, Mapping) else None
        for model in _chosen(field, own):
            yield from _paths(model, own, f"{prefix}{name}.")
