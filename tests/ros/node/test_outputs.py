"""Colours of the depth that viewers show."""

from __future__ import annotations

import builtins
import sys
from typing import Any

import numpy as np
import pytest

from dyfn_ros.node.outputs import ColourScale


def test_the_first_colours_import_no_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """The inference thread paints them; an import there made every camera wait for a second."""
    imported: list[str] = []
    load = builtins.__import__

    def noted(name: str, *arguments: Any, level: int = 0) -> Any:
        if not (level or (len(arguments) == 4 and arguments[3])):  # no relative name
            imported.append(name)
        return load(name, *arguments, level=level) if level else load(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", noted)
    depth = np.linspace(1, 9, 36 * 48).reshape(36, 48)
    depth[0, 0] = np.nan
    painted = ColourScale().paint(depth)
    monkeypatch.undo()
    assert painted.shape == (36, 48, 3) and painted[0, 0].tolist() == [70, 70, 70]
    packages = {name.split(".")[0] for name in imported} - sys.stdlib_module_names
    assert packages <= {"numpy"}
