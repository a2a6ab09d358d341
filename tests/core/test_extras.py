"""A command without its extra says in one line which one it needs."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dyfn_core.extras import MODULES, missing

ROOT = Path(__file__).resolve().parents[2]
WORLDS = ("moderngl", "embreex")
# Runs an entry point in a process that cannot find some modules.
HIDING = """
import sys
from importlib import import_module
hidden, module, function, *words = sys.argv[1:]
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden.split(","):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Hidden())
sys.argv[1:] = words
sys.exit(getattr(import_module(module), function)())
"""


def without(modules: Sequence[str], place: str, *words: str) -> subprocess.CompletedProcess[str]:
    module, function = place.split(":")
    arguments = [sys.executable, "-c", HIDING, ",".join(modules), module, function, *words]
    return subprocess.run(arguments, capture_output=True, text=True, cwd=ROOT, check=False)


@pytest.mark.parametrize(
    ("line", "hidden", "extra"),
    [
        ("dyfn_ros.commands:stream_depth", MODULES["ros"], "ros"),
        ("dyfn_worlds.commands:main --assets . --out o", WORLDS, "worlds"),
        pytest.param(
            "dyfn_core.cli.commands:train dyfn --data . --out o",
            MODULES["train"],
            "train",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_command_that_cannot_do_without_its_extra_names_it(
    line: str, hidden: Sequence[str], extra: str
) -> None:
    done = without(hidden, *line.split())
    assert done.returncode in (1, 2), done.stderr
    assert done.stderr.count("\n") == 1 and f"pip install 'dyfn_ros[{extra}]'" in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("command", "hidden", "extra", "words"),
    [
        ("depth", "av", "video", ("photo.png", "--write", "video")),
        ("depth", "rerun", "rerun", ("photo.png", "--view")),
        ("depth", "OpenEXR", "datasets", ("photo.png", "--write", "exr")),
        ("demo", "rclpy", "ros", ("photos", "--out", "out")),
    ],
)
def test_an_option_without_its_extra_names_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: str,
    hidden: str,
    extra: str,
    words: Sequence[str],
) -> None:
    from dyfn_ros import commands

    for name in ("photo.png", "photos/1.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        assert cv2.imwrite(str(tmp_path / name), np.zeros((8, 8, 3), np.uint8))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, hidden, None)  # type: ignore[arg-type]
    monkeypatch.delitem(sys.modules, "dyfn_ros.demo.live_player", raising=False)
    monkeypatch.setattr(sys, "argv", [command, *words])
    assert getattr(commands, command)() in (1, 2)
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"pip install 'dyfn_ros[{extra}]'" in said, said


def test_a_module_of_no_extra_is_named_as_it_is() -> None:
    told = missing(ModuleNotFoundError("No module named 'yaml'", name="yaml"))
    assert told == "No module named 'yaml'; install this package again: pip install dyfn_ros"


def test_every_library_of_an_extra_is_known() -> None:
    toml: Any = pytest.importorskip("tomllib", reason="Python 3.11 reads TOML")
    content = toml.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    extras = content["project"]["optional-dependencies"]
    assert set(MODULES) == set(extras) - {"worlds", "docs", "test", "dev", "all"}
