"""The manual: lines fit, links and paths exist, the picture of the rooms is current."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.core.test_layering import ABOVE, ROOMS
from tests.support import rooms_picture
from tests.test_commands import PARSERS

ROOT = Path(__file__).resolve().parents[1]
MOST_COLUMNS = 110
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        ROOT / "bags/README.md",
        ROOT / "tests/golden/README.md",
        ROOT / "dyfn_core/weights/README.md",
    ]
)
PACKAGES = tuple(ROOMS)
FOLDERS = (*PACKAGES, "tests", "docs", "config", "launch", "benchmarks", "bags")
LINK = re.compile(r"\]\(([^)\s]+)\)")
PATH = re.compile(rf"(?<![\w/.~<-])(?:{'|'.join(FOLDERS)})/[\w./*-]*\w")
MODULE = re.compile(r"(?:python|python3) -m ([\w.]+)")
DOTTED = re.compile(rf"\b(?:{'|'.join(PACKAGES)})(?:\.\w+)+")


def page_id(page: Path) -> str:
    return str(page.relative_to(ROOT))


every_page = pytest.mark.parametrize("page", PAGES, ids=page_id)
# History keeps the commands and names of its time.
every_current_page = pytest.mark.parametrize(
    "page", [page for page in PAGES if page.parent.name != "history"], ids=page_id
)


def too_long(line: str) -> bool:
    """A table's row cannot be broken, so one that holds code or a link may be as long as it is."""
    if line.startswith("|") and ("`" in line or LINK.search(line)):
        return False
    return len(line) > MOST_COLUMNS


def anchors(page: Path) -> set[str]:
    """The names under which the headings of a page can be linked to."""
    found = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in found}


def broken_links(page: Path) -> Iterator[str]:
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            yield link


def missing_module(name: str) -> bool:
    """Whether a dotted name leads to no module, nor to a name that a module's source holds."""
    path, parts = ROOT, name.split(".")
    while parts and (path / parts[0]).is_dir():
        path /= parts.pop(0)
    if parts and (path / f"{parts[0]}.py").is_file():
        path /= f"{parts.pop(0)}.py"
    source = path / "__init__.py" if path.is_dir() else path
    return bool(parts) and not re.search(rf"\b{parts[0]}\b", source.read_text(encoding="utf-8"))


def commands(text: str) -> Iterator[list[str]]:
    """The words of every command line of this project in the code blocks and spans of a page."""
    text = re.sub(r"\\\n\s*", " ", text)
    lines = re.findall(r"^(?: {4})?(dyfn-\w+ .+)$", text, flags=re.MULTILINE)
    lines += re.findall(r"`(dyfn-\w+ [^`\n]+)`", text)
    for line in lines:
        yield shlex.split(line.replace("[", " ").replace("]", " "), comments=True)


def unknown_words(words: list[str]) -> list[str]:
    """The command, the sub-command or the options of a line that are not offered."""
    if words[0] not in PARSERS:
        return words[:1]
    parser = PARSERS[words[0]]()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            if words[1] not in action.choices and words[1] != "--version":
                return [words[1]]
            parser = action.choices.get(words[1], parser)
    offered = {
        name
        for action in parser._actions
        if action.help != argparse.SUPPRESS  # the old name of an option
        for name in action.option_strings
    }
    return [word for word in words if word.startswith("--") and word not in offered]


@every_page
def test_lines_fit(page: Path) -> None:
    lines = page.read_text(encoding="utf-8").splitlines()
    assert [f"{n}: {line}" for n, line in enumerate(lines, 1) if too_long(line)] == []


@every_page
def test_links_resolve(page: Path) -> None:
    assert list(broken_links(page)) == []


@every_current_page
def test_named_paths_exist(page: Path) -> None:
    named = set(PATH.findall(page.read_text(encoding="utf-8")))
    assert [path for path in sorted(named) if not any(ROOT.glob(path))] == []


@every_current_page
def test_named_modules_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    own = {name for name in MODULE.findall(text) if name.split(".")[0] in FOLDERS}
    packaging = [ROOT / name for name in ("setup.py", "pyproject.toml")]
    entry_points = "".join(path.read_text(encoding="utf-8") for path in packaging if path.exists())
    named = own | {name for name in DOTTED.findall(text) if f'"{name}"' not in entry_points}
    assert [name for name in sorted(named) if missing_module(name)] == []


@every_current_page
def test_commands_are_offered(page: Path) -> None:
    lines = commands(page.read_text(encoding="utf-8"))
    wrong = {shlex.join(words): unknown_words(words) for words in lines}
    assert {line: words for line, words in wrong.items() if words} == {}


def test_checks_find_what_is_wrong(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A `b` c\n[a](#a-b-c) [b](#no) [c](no.md) [d](https://host/no)\n")
    assert list(broken_links(page)) == ["#no", "no.md"]
    assert too_long("x" * 111)
    assert too_long("| " + "x" * 111)
    assert not too_long("| `" + "x" * 111)
    assert PATH.findall("`tests/core/no.py`, out/tests/x, config/*.yaml.") == [
        "tests/core/no.py",
        "config/*.yaml",
    ]
    text = "    dyfn-eval run --data D \\\n        --no 1  # why\n\n`dyfn-train no`, `dyfn-x y`.\n"
    assert [unknown_words(words) for words in commands(text)] == [["--no"], ["no"], ["dyfn-x"]]
    assert unknown_words(["dyfn-eval", "run", "--root", "R"]) == ["--root"]
    assert missing_module("dyfn_core.models.no")
    assert not missing_module("dyfn_core.models.load_model")
    assert not missing_module("dyfn_core.geometry.camera.pixel_intrinsics")


def test_picture_of_the_rooms_is_current() -> None:
    assert rooms_picture.PICTURE.read_text(encoding="utf-8") == rooms_picture.picture(), (
        "write it again: python -m tests.support.rooms_picture"
    )


@pytest.mark.parametrize("package", PACKAGES)
def test_architecture_page_names_every_room(package: str) -> None:
    page = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
    for room in {*ROOMS[package], *ABOVE[package]}:
        assert f"`{room}/`" in page or f"`{room}.py`" in page, room
