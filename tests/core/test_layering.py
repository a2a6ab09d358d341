"""Who may import whom (the design's layers), read off the sources."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# part of dyfn_core -> the parts it may import. A part is the first name below dyfn_core.
MAY_IMPORT = {
    "prediction": set(),
    "geometry": {"prediction"},
    "models": {"prediction", "geometry"},
    "stream": {"prediction", "geometry", "models"},
    "metric": {"prediction", "geometry"},
    "streaming": {"prediction", "geometry", "models", "stream", "metric"},
    "losses": {"prediction", "geometry"},
    "data": {"prediction", "geometry"},
    "training": {"prediction", "geometry", "models", "losses", "data"},
    "evaluation": {"prediction", "geometry", "models", "stream", "data", "metric"},
    "experiments": {
        "prediction",
        "geometry",
        "models",
        "stream",
        "losses",
        "data",
        "metric",
        "training",
        "evaluation",
    },
}
ROS = {"rclpy", "rosbags", "mcap", "sensor_msgs", "std_msgs", "std_srvs", "geometry_msgs"}


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


def part(module: str) -> str | None:
    names = module.split(".")
    return names[1] if names[0] == "dyfn_core" and len(names) > 1 else None


def violations(module: str, source: str) -> list[str]:
    """What a module of dyfn_core imports and must not."""
    own = part(module)
    package = module.rpartition(".")[0]
    names = set(imports(source, package))
    found = [name for name in names if name.split(".")[0] in {*ROS, "dyfn_ros"}]
    if own in MAY_IMPORT:
        parts = {part(name) for name in names} & {*MAY_IMPORT, "cli"}
        found += [f"dyfn_core.{other}" for other in parts - MAY_IMPORT[own] - {own}]
    return sorted(set(found))


def modules(package: str) -> list[tuple[str, Path]]:
    return [
        (".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"), path)
        for path in sorted((ROOT / package).rglob("*.py"))
    ]


@pytest.mark.parametrize(("module", "path"), modules("dyfn_core"), ids=lambda value: str(value))
def test_module_imports_only_what_its_layer_may(module: str, path: Path) -> None:
    assert not violations(module, path.read_text()), path


def test_ros_package_takes_its_geometry_from_the_core() -> None:
    """dyfn_ros may know all of the core but its training."""
    for _, path in modules("dyfn_ros"):
        names = imports(path.read_text(), "dyfn_ros")
        assert not [name for name in names if part(name) in ("training", "losses")], path


def test_the_check_itself_sees_every_kind_of_import() -> None:
    source = "\n".join(
        [
            "import rclpy.node",
            "def f():",
            "    from dyfn_core.stream.depth_stream import DepthStream",
            "from dyfn_core import evaluation",
            "from ..training import trainer",
            "from .base import Latent",
            "import dyfn_core.geometry.camera as camera",
        ]
    )
    assert violations("dyfn_core.models.moge", source) == [
        "dyfn_core.evaluation",
        "dyfn_core.stream.depth_stream",
        "dyfn_core.training",
        "rclpy.node",
    ]


def test_every_part_is_in_the_table() -> None:
    parts = {part(module) for module, _ in modules("dyfn_core")} - {None, "cli"}
    assert parts <= set(MAY_IMPORT)
