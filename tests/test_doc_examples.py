"""Every fenced example of the manual is run, or says why it is not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

from dyfn_ros.recordings.rgbd_writer import write_rgbd_recording
from tests.support.made_videos import make_video, panning
from tests.support.rgbd_frames import rgbd
from tests.test_docs import PAGES, ROOT, page_id

FENCE = re.compile(
    r"(?:^<!-- not run: (?P<reason>[^\n]+) -->\n)?^```(?P<language>\w*)\n(?P<code>.*?)^```$",
    flags=re.MULTILINE | re.DOTALL,
)
CURRENT = [page for page in PAGES if page.parent.name != "history"]


class Example(NamedTuple):
    language: str
    code: str
    reason: str | None


def examples(page: Path) -> Iterator[Example]:
    for found in FENCE.finditer(page.read_text(encoding="utf-8")):
        yield Example(found["language"], found["code"], found["reason"])


def pages_with(language: str) -> Any:
    pages = [
        page
        for page in CURRENT
        if any(one.language == language and one.reason is None for one in examples(page))
    ]
    return pytest.mark.parametrize("page", pages, ids=page_id)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where an example runs: with the files that the manual speaks of."""
    make_video(tmp_path / "walk.mp4", [0, 0.1, 0.2, 0.3], size=(72, 96), picture=panning)
    write_rgbd_recording(tmp_path / "made", rgbd(4))
    next((tmp_path / "made").glob("*.mcap")).rename(tmp_path / "recording.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names() -> dict[str, Any]:
    """What an example in Python takes for given."""
    frames = [panning(index, (48, 64)) for index in range(2)]
    return {
        "frames": frames,
        "image": frames[0],
        "next_image": frames[1],
        "stamp": 0.5,
        "K": np.array([[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]]),
        "points": np.array([[0.1, 0.1, 2.0]]),
        "T_world_camera": np.eye(4),
    }


@pages_with("sh")
def test_commands_run(page: Path, folder: Path) -> None:
    paths = [str(Path(sys.executable).parent), os.environ["PATH"]]
    environment = {**os.environ, "PATH": os.pathsep.join(paths)}
    script = "".join(one.code for one in examples(page) if one.language == "sh" and not one.reason)
    done = subprocess.run(
        ["bash", "-e", "-u", "-c", script],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]


@pages_with("python")
def test_python_runs(page: Path, folder: Path) -> None:
    given = names()
    for one in examples(page):
        if one.language == "python" and one.reason is None:
            exec(compile(one.code, page_id(page), "exec"), given)


@pages_with("yaml")
def test_yaml_is_yaml(page: Path) -> None:
    for one in examples(page):
        if one.language == "yaml" and one.reason is None:
            assert yaml.safe_load(one.code)


@pytest.mark.slow
def test_the_notebook_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    client = pytest.importorskip("nbclient", reason="the extra `docs` is not installed")
    import nbformat

    monkeypatch.setenv("FRAMES", "3")
    path = ROOT / "docs/notebooks/quickstart.ipynb"
    notebook = nbformat.read(path, nbformat.current_nbformat)
    resources = {"metadata": {"path": str(path.parent)}}
    client.NotebookClient(notebook, timeout=300, resources=resources).execute()
    said = [output.get("text", "") for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("3 frames; the last one is not in metres" in text for text in said)


def test_every_example_has_a_language_that_is_run_or_a_reason() -> None:
    loose = [
        f"{page_id(page)}: {one.code.splitlines()[0]}"
        for page in CURRENT
        for one in examples(page)
        if one.reason is None and one.language not in ("sh", "python", "yaml", "")
    ]
    assert loose == []
