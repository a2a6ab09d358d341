"""Dockerfile, compose files and workflows name files, commands and targets that exist."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yaml"))
COMPOSED = sorted((ROOT / "docker").glob("compose*.yaml"))
PROJECT = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
SCRIPTS = set(re.findall(r'^([\w-]+) = "dyfn_\w+\.[\w.]+:\w+"', PROJECT, flags=re.MULTILINE))


def loaded(path: Path) -> dict[str, Any]:
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert isinstance(content, dict)
    return content


def runs(workflow: dict[str, Any]) -> Iterator[str]:
    for job in workflow["jobs"].values():
        yield from (step["run"] for step in job["steps"] if "run" in step)


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_call_targets_of_the_makefile(path: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    called = {word for line in runs(loaded(path)) for word in re.findall(r"^make ([\w-]+)", line)}
    assert called and called <= targets


def test_the_matrix_is_the_supported_pythons() -> None:
    matrix = loaded(ROOT / ".github/workflows/test.yaml")["jobs"]["test"]["strategy"]["matrix"]
    stated = re.findall(r"Programming Language :: Python :: (3\.\d+)", PROJECT)
    assert matrix["python"] == stated


@pytest.mark.parametrize("path", COMPOSED, ids=lambda path: path.name)
def test_composed_services_build_and_run_what_is_there(path: Path) -> None:
    known = set(loaded(ROOT / "docker/compose.yaml")["services"])
    for name, service in loaded(path)["services"].items():
        assert name in known
        if "build" in service:
            build = service["build"]
            assert (path.parent / build["context"] / build["dockerfile"]).is_file()
            assert service["command"].split()[0] in {*SCRIPTS, "ros2"}


def test_the_image_copies_and_runs_what_is_there() -> None:
    text = (ROOT / "docker/Dockerfile").read_text(encoding="utf-8")
    for source in re.findall(r"^COPY (\S+) ", text, flags=re.MULTILINE):
        assert (ROOT / source).exists(), source
    (command,) = re.findall(r'^CMD \["([\w-]+)"\]', text, flags=re.MULTILINE)
    assert command in SCRIPTS
    named = re.findall(r"\.\[([\w,]+)\]", text)[0].split(",")
    assert all(re.search(rf"^{extra} = \[", PROJECT, flags=re.MULTILINE) for extra in named)
    assert (ROOT / "docker/entrypoint.sh").stat().st_mode & 0o111
