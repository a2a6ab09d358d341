"""The public face of dyfn_core: dir and help show it, its docstrings say what goes in and out."""

from __future__ import annotations

import doctest
import inspect
import pydoc
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from importlib import import_module
from typing import Any

import pytest

import dyfn_core

NAMES = sorted(set(dyfn_core.__all__) - {"__version__"})
NEEDED = {
    *("DepthStream", "StreamSession", "StreamOptions", "push_together", "load_model"),
    *("save_model", "Frame", "Prediction", "StreamState", "PointReference", "__version__"),
}
MODULES = sorted({dyfn_core._HOMES[name] for name in NAMES} | {"dyfn_core"})
DOCTESTED = [*MODULES, "dyfn_core.models.checkpoints", "dyfn_core.models.device"]


def functions(name: str) -> Iterator[tuple[str, Callable[..., Any]]]:
    """What of a public object is called by its users: itself, or __init__ and public methods."""
    found = getattr(dyfn_core, name)
    if inspect.isfunction(found):
        yield name, found
        return
    for key, value in vars(found).items():
        function = value.__func__ if isinstance(value, (staticmethod, classmethod)) else value
        made_here = key == "__init__" and not is_dataclass(found)
        if inspect.isfunction(function) and (made_here or not key.startswith("_")):
            yield f"{name}.{key}", function


FUNCTIONS = dict(pair for name in NAMES for pair in functions(name))


def test_dir_shows_the_face() -> None:
    assert set(dyfn_core.__all__) >= NEEDED
    assert set(dir(dyfn_core)) >= set(dyfn_core.__all__)


def test_help_shows_the_face() -> None:
    shown = pydoc.render_doc(dyfn_core, renderer=pydoc.plaintext)
    for name in NAMES:
        assert name in shown, name
        assert str(inspect.getdoc(getattr(dyfn_core, name))).splitlines()[0] in shown, name
    assert f"VERSION\n    {dyfn_core.__version__}" in shown


def test_face_is_imported_on_first_use_only() -> None:
    """A command's --help, or a process that only moves files, does without torch."""
    code = "import dyfn_core as d, sys; dir(d); d.__version__; print('torch' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "False\n"


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'dyfn_core' has no attribute 'absent'"):
        _ = dyfn_core.absent


@pytest.mark.parametrize("name", NAMES)
def test_class_says_what_it_holds(name: str) -> None:
    found = getattr(dyfn_core, name)
    assert inspect.getdoc(found), name
    if is_dataclass(found) and name != "StreamOptions":  # whose fields describe themselves
        assert "Attributes:\n" in str(inspect.getdoc(found)), name


@pytest.mark.parametrize("name", FUNCTIONS)
def test_function_says_what_goes_in_and_out(name: str) -> None:
    text = inspect.getdoc(FUNCTIONS[name])
    assert text, name
    signature = inspect.signature(FUNCTIONS[name])
    taken = set(signature.parameters) - {"self", "cls"}
    if taken:
        assert "Args:\n" in text, f"{name} takes {sorted(taken)}"
        for parameter in taken:
            assert f"    {parameter}: " in text, f"{name}: {parameter}"
    if signature.return_annotation not in (None, "None"):
        assert "Returns:\n" in text, name


@pytest.mark.parametrize("module", DOCTESTED)
def test_examples_are_right(module: str) -> None:
    failed, tried = doctest.testmod(import_module(module), optionflags=doctest.ELLIPSIS)
    assert not failed
    if module == "dyfn_core":
        assert tried


def test_every_way_to_a_prediction_has_an_example() -> None:
    for name in ("DepthStream", "StreamSession", "StreamOptions", "push_together", "load_model"):
        assert ">>> " in str(inspect.getdoc(getattr(dyfn_core, name))), name
