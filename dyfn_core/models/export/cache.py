"""Exported parts of models, kept as files that are used only for what they were made of."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import onnx
import torch

import dyfn_core.geometry
import dyfn_core.models
from dyfn_core import __version__
from dyfn_core.files import OutputError, finished_file
from dyfn_core.models.export.folder import export_folder
from dyfn_core.models.formats import CheckpointError

logger = logging.getLogger(__name__)

KEY = "dyfn_ros_part"  # of a file's metadata


def cached(made_of: dict[str, Any], make: Callable[[], onnx.ModelProto]) -> Path | bytes:
    """The graph that `make` gives, from the cache if it is there.

    Args:
        made_of: What decides the graph, as JSON-able values: weights, part, sizes. The versions of
            dyfn_ros, its code and torch come to it.
        make: Makes the graph.

    Returns:
        The file in the cache; the content where the cache cannot be written, which is warned of.

    Raises:
        CheckpointError: The file in the cache was made of something else; names file and entry.
    """
    made_of = {**made_of, "version": __version__, "code": _code(), "torch": torch.__version__}
    told = json.dumps(made_of, sort_keys=True)
    digest = hashlib.sha256(told.encode()).hexdigest()[:16]
    path = export_folder() / f"{made_of['type']}-{made_of['part']}-{digest}.onnx"
    if path.exists():
        _check(path, made_of)
        logger.info("%s: used", path)
        return path
    graph = make()
    onnx.helper.set_model_props(graph, {KEY: told})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with finished_file(path) as partial:
            onnx.save(graph, str(partial))
    except (OSError, OutputError) as error:
        logger.warning("an exported %s is not kept: %s", made_of["part"], error)
        return bytes(graph.SerializeToString())
    logger.info("%s: exported", path)
    return path


def _check(path: Path, made_of: dict[str, Any]) -> None:
    try:
        graph = onnx.load(str(path), load_external_data=False)
        props = {entry.key: entry.value for entry in graph.metadata_props}
        found = json.loads(props[KEY])
        assert isinstance(found, dict)
    except Exception as error:  # protobuf has errors of its own
        raise CheckpointError(
            f"{path} is no exported part of a model ({type(error).__name__}): delete it"
        ) from error
    expected = json.loads(json.dumps(made_of))
    other = [name for name in sorted({*found, *expected}) if found.get(name) != expected.get(name)]
    if other:
        listed = ", ".join(f"{n} is {found.get(n)!r}, expected {expected.get(n)!r}" for n in other)
        raise CheckpointError(f"{path} was exported from something else: {listed}; delete it")


@cache
def _code() -> str:
    """SHA-256 of the code that models are made of: a source tree changes without its version."""
    digest = hashlib.sha256()
    for package in (dyfn_core.models, dyfn_core.geometry):
        for folder in package.__path__:
            for path in sorted(Path(folder).rglob("*.py")):
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
