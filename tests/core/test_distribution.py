"""What pyproject.toml promises: one version, types, and commands that exist."""

from __future__ import annotations

import ast
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("dyfn_core", "dyfn_ros", "dyfn_worlds")


@pytest.fixture(scope="module")
def project() -> dict[str, Any]:
    toml = pytest.importorskip("tomllib", reason="Python 3.11 reads TOML")
    return toml.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_ros_and_python_packages_have_one_version(project: dict[str, Any]) -> None:
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.findtext("version") == project["project"]["version"]
    assert manifest.findtext("name") == project["project"]["name"]
    assert manifest.findtext("url") == project["project"]["urls"]["Paper"]
    assert [manifest.findtext("author")] == [one["name"] for one in project["project"]["authors"]]


@pytest.mark.parametrize("package", PACKAGES)
def test_package_ships_its_types(project: dict[str, Any], package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()
    assert "py.typed" in project["tool"]["setuptools"]["package-data"][package]


def test_package_data_are_there(project: dict[str, Any]) -> None:
    for package, patterns in project["tool"]["setuptools"]["package-data"].items():
        for pattern in patterns:
            assert any((ROOT / package).glob(pattern)), f"{package}/{pattern}"


def test_every_command_has_its_function(project: dict[str, Any]) -> None:
    scripts = project["project"]["scripts"]
    assert len(scripts) == 10
    for command, place in scripts.items():
        module, function = place.split(":")
        spec = find_spec(module)
        assert spec is not None and spec.origin is not None, command
        tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
        names = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        assert function in names, command


def test_extras_name_extras_that_exist(project: dict[str, Any]) -> None:
    extras = project["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    named = everything.removeprefix("dyfn_ros[").removesuffix("]").split(",")
    assert {*named, "test", "all"} == set(extras)  # `dev` has `test`


def test_the_demo_recording_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """setup.py ships it, and an installation finds it from anywhere."""
    from dyfn_ros.demo import options

    assert '"bags/demo"' in (ROOT / "setup.py").read_text(encoding="utf-8")
    share = tmp_path / "share/dyfn_ros/bags/demo"
    share.mkdir(parents=True)
    elsewhere = tmp_path / "lib/python3.12/site-packages/dyfn_ros/demo/options.py"
    monkeypatch.setattr(options, "__file__", str(elsewhere))
    monkeypatch.chdir(tmp_path / "share")
    assert options.default_recording() == share


def test_pixi_has_the_packages_version_floor(project: dict[str, Any]) -> None:
    toml = pytest.importorskip("tomllib", reason="Python 3.11 reads TOML")
    pixi = toml.loads((ROOT / "pixi.toml").read_text(encoding="utf-8"))
    needed = dict(text.split(">=") for text in project["project"]["dependencies"] if ">=" in text)
    assert pixi["dependencies"]["pytorch"] == f">={needed['torch']}"
    extras = project["project"]["optional-dependencies"]
    (ours,) = pixi["pypi-dependencies"].values()
    assert set(ours["extras"]) <= set(extras)
    tasks = {words.split()[0] for words in pixi["tasks"].values()}
    assert tasks <= set(project["project"]["scripts"])
