"""Commands of the manual that start the node: what they name is there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from dyfn_ros.node.parameters.table import SPECS
from tests.support.launch_stand_in import ROOT, declared
from tests.test_docs import PAGES, page_id

CURRENT = [page for page in PAGES if page.parent.name not in ("history", "golden", "weights")]
NODE = r"(?:ros2 (?:launch|run) dyfn_ros|stream_depth --ros-args)\b"
LINE = re.compile(rf"^ *({NODE}.*)$", flags=re.MULTILINE)
SPAN = re.compile(rf"`({NODE}[^`]*)`")
INCLUDED = "$(ros2 pkg prefix dyfn_ros --share)/"
OF_ROS = {"use_sim_time"}


def commands(text: str) -> Iterator[list[str]]:
    """The words of every command line that starts the node."""
    joined = re.sub(r"\\\n\s*", " ", text).replace(INCLUDED, "")
    for line in [*LINE.findall(joined), *SPAN.findall(joined)]:
        yield shlex.split(line.replace("[", "").replace("]", "").split(" #")[0])


def wrong(words: list[str]) -> Iterator[str]:
    """What a command names that is not there."""
    given = dict(word.split(":=", 1) for word in words if ":=" in word)
    if words[:2] == ["ros2", "launch"]:
        path = ROOT / "launch" / words[3]
        if not path.is_file():
            yield words[3]
            return
        yield from sorted(set(given) - set(declared(path)))
        files = [value for name, value in given.items() if name == "params_file"]
    else:
        names = [words[i + 1].split(":=")[0] for i, word in enumerate(words) if word == "-p"]
        known = {*SPECS, *OF_ROS}
        yield from (name for name in names if name.rsplit(".", 1)[-1] not in known)
        files = [words[i + 1] for i, word in enumerate(words) if word == "--params-file"]
    for file in files:
        if not any(ROOT.glob(file)) and not any((ROOT / "config").rglob(file)):
            yield file


@pytest.mark.parametrize("page", CURRENT, ids=page_id)
def test_what_a_command_names_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    found = {shlex.join(words): list(wrong(words)) for words in commands(text)}
    assert {line: names for line, names in found.items() if names} == {}


def test_what_is_not_there_is_found() -> None:
    text = (
        "    ros2 launch dyfn_ros stream_depth.launch.py imgae:=/x \\\n"
        "        params_file:=$(ros2 pkg prefix dyfn_ros --share)/config/no.yaml\n"
        "\n`ros2 launch dyfn_ros no.launch.py a:=b` and `stream_depth --ros-args -p maxrate:=5`.\n"
        "    stream_depth --ros-args --params-file realsense.yaml -p front.device:=cuda:0\n"
    )
    assert [list(wrong(words)) for words in commands(text)] == [
        ["imgae", "config/no.yaml"],
        [],
        ["no.launch.py"],
        ["maxrate"],
    ]
    assert any(list(commands(page.read_text(encoding="utf-8"))) for page in CURRENT)
