"""Who may import whom (docs/architecture.md), read off the sources of all three packages."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

_WORDS = {"prediction", "quantities", "files", "threads", "argument_types", "extras"}
_MODELS = _WORDS | {"geometry", "models"}
# Room -> the rooms of the same package that it may import. A room is the first name below the
# package. docs/pictures/rooms.svg is drawn from this table: python -m tests.support.rooms_picture
ROOMS: dict[str, dict[str, set[str]]] = {
    "dyfn_core": {
        **{word: set() for word in ("quantities", "files", "threads", "argument_types", "extras")},
        "geometry": _WORDS - {"prediction"},
        "prediction": {"geometry", "quantities"},
        "metric": _WORDS | {"geometry"},
        "models": _WORDS | {"geometry"},
        "scoring": _WORDS | {"geometry"},
        "data": _WORDS | {"geometry"},
        "losses": _WORDS | {"geometry"},
        "stream": _MODELS | {"metric"},
        "training": _MODELS | {"losses", "data", "scoring"},
        "adaptation": _MODELS | {"metric", "scoring", "data", "stream", "losses", "training"},
        "evaluation": _MODELS | {"metric", "scoring", "data", "stream"},
        "experiments": _MODELS
        | {"metric", "scoring", "data", "stream", "losses", "training", "evaluation"},
    },
    "dyfn_ros": {
        "messages": set(),
        "recordings": {"messages"},
        "replay": {"recordings", "messages"},
        "record": {"recordings", "messages"},
        "depth": {"recordings", "messages", "replay"},
        "app": {"depth", "recordings", "replay"},
        "node": {"messages"},
    },
    "dyfn_worlds": {
        "scene": set(),
        "render": {"scene"},
        "shards": {"render"},
        "camera": {"scene", "render", "shards"},
        "maps": {"scene"},
        "rooms": {"scene", "maps"},
    },
}
# The rooms that stand above all others of their package.
ABOVE = {
    "dyfn_core": {"cli"},
    "dyfn_ros": {"demo", "commands"},
    "dyfn_worlds": {"cli", "commands", "generate", "casting", "render_shards"},
}
# Packages from outside -> where they may be imported: "package" or "package.room".
RCLPY, BAGS = ("rclpy",), ("rosbags", "mcap", "apsw")
ROS_TYPES = (
    *("sensor_msgs", "std_msgs", "std_srvs", "geometry_msgs", "diagnostic_msgs"),
    *("nav_msgs", "tf2_msgs"),
)
HOMES: dict[tuple[str, ...], set[str]] = {
    RCLPY: {"dyfn_ros.node", "dyfn_ros.demo"},
    BAGS: {"dyfn_ros.recordings"},
    ROS_TYPES: {"dyfn_ros"},
    ("dyfn_ros",): {"dyfn_ros"},
    ("dyfn_worlds",): {"dyfn_worlds"},
    ("dyfn_core",): {"dyfn_core", "dyfn_ros"},
    ("dyfn_core.training", "dyfn_core.losses"): {"dyfn_core"},
}


def imports(source: str, package: str) -> Iterator[str]:
    """Absolute names of all modules that a source imports, wherever in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else ""
            module = ".".join(filter(None, [base, node.module]))
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def room(module: str) -> str | None:
    names = module.split(".")
    return names[1] if names[0] in ROOMS and len(names) > 1 else None


def inside(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def violations(module: str, source: str) -> list[str]:
    """What a module imports and must not."""
    top, own = module.split(".")[0], room(module)
    names = set(imports(source, module.rpartition(".")[0]))
    found = {
        name
        for packages, homes in HOMES.items()
        for name in names
        if any(inside(name, package) for package in packages)
        and not any(inside(module, home) for home in homes)
    }
    rooms = ROOMS[top]
    if own in rooms:
        others = {room(name) for name in names if inside(name, top)} - {None, own}
        known = {path.stem for path in (ROOT / top).iterdir()}
        found |= {f"{top}.{other}" for other in others & known - rooms[own]}
    return sorted(found)


def modules(package: str) -> list[tuple[str, Path]]:
    return [
        (".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), path)
        for path in sorted((ROOT / package).rglob("*.py"))
    ]


ALL = [pair for package in ROOMS for pair in modules(package)]


@pytest.mark.parametrize(("module", "path"), ALL, ids=lambda value: str(value))
def test_module_imports_only_what_its_room_may(module: str, path: Path) -> None:
    assert not violations(module, path.read_text(encoding="utf-8")), path


def graph() -> dict[str, set[str]]:
    """Module -> the modules of this project that it imports, type checking's apart."""
    known = dict(ALL)
    found: dict[str, set[str]] = {}
    for module, path in ALL:
        package = module if path.name == "__init__.py" else module.rpartition(".")[0]
        names = set(imports(path.read_text(encoding="utf-8"), package))
        found[module] = {name for name in names if name in known} - {module}
    return found


def circle(edges: Mapping[str, set[str]]) -> list[str]:
    """A circle of modules, its first one again at the end; empty when there is none."""
    done: set[str] = set()

    def visit(module: str, way: list[str]) -> list[str]:
        if module in way:
            return [*way[way.index(module) :], module]
        if module in done:
            return []
        for other in sorted(edges[module]):
            if found := visit(other, [*way, module]):
                return found
        done.add(module)
        return []

    return next((found for module in edges if (found := visit(module, []))), [])


def without_packages(edges: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """`from package import module` names the package as well, which is no use of its contents."""
    packages = {module for module, path in ALL if path.name == "__init__.py"}
    return {
        module: {
            other
            for other in others
            if other not in packages or not any(o.startswith(f"{other}.") for o in others)
        }
        for module, others in edges.items()
    }


def test_no_circle_anywhere() -> None:
    assert circle(without_packages(graph())) == []


def test_a_circle_is_found() -> None:
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


def test_the_check_itself_sees_every_kind_of_import() -> None:
    source = "\n".join(
        [
            "import rclpy.node",
            "def f():",
            "    from dyfn_core.stream import DepthStream",
            "from dyfn_core import evaluation",
            "from ..training import trainer",
            "from .base import Latent",
            "import dyfn_core.geometry.camera as camera",
        ]
    )
    assert violations("dyfn_core.models.moge", source) == [
        "dyfn_core.evaluation",
        "dyfn_core.stream",
        "dyfn_core.training",
        "rclpy.node",
    ]
    assert violations("dyfn_ros.replay.run", "import mcap.reader") == ["mcap.reader"]
    assert violations("dyfn_ros.recordings.ros", "from dyfn_ros.node import node")


def test_every_room_is_in_the_table() -> None:
    for package, rooms in ROOMS.items():
        found = {room(module) for module, _ in modules(package)} - {None}
        assert found == {*rooms, *ABOVE[package]}, package
