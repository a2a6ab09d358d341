"""What launch files use of ROS launch, which no wheels have: -> the processes they would start.

Each class takes the arguments that this project's files give it, and no others: a misspelt one is a
TypeError here as there.
"""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Process:
    """One node that a launch file starts, everything resolved.

    files: parameter files. values: parameters that come before them.
    """

    package: str
    executable: str
    name: str
    namespace: str
    files: tuple[Path, ...]
    values: Mapping[str, Any]
    remappings: Mapping[str, str]
    arguments: tuple[str, ...]

    @property
    def command_line(self) -> list[str]:
        """What comes after --ros-args."""
        words: list[str] = []
        if self.name:
            words += ["-r", f"__node:={self.name}"]
        if self.namespace:
            words += ["-r", f"__ns:=/{self.namespace.strip('/')}"]
        for path in self.files:
            words += ["--params-file", str(path)]
        for name, value in self.values.items():
            words += ["-p", f"{name}:={json.dumps(value)}"]
        for ours, theirs in self.remappings.items():
            words += ["-r", f"{ours}:={theirs}"]
        return words


@dataclass
class LaunchContext:
    """descriptions: of the declared arguments, by name."""

    launch_configurations: dict[str, str] = field(default_factory=dict)
    descriptions: dict[str, str] = field(default_factory=dict)


class LaunchConfiguration:
    def __init__(self, variable_name: str) -> None:
        self._name = variable_name

    def perform(self, context: LaunchContext) -> str:
        return context.launch_configurations[self._name]


class FindPackageShare:
    """Share folders have the layout of this repository."""

    def __init__(self, package: str) -> None:
        assert package == "dyfn_ros", package

    def perform(self, context: LaunchContext) -> str:
        return str(ROOT)


class PathJoinSubstitution:
    def __init__(self, substitutions: Iterable[Any]) -> None:
        self._parts = list(substitutions)

    def perform(self, context: LaunchContext) -> str:
        return str(Path(*(text(part, context) for part in self._parts)))


def text(value: Any, context: LaunchContext) -> str:
    """A string, a substitution, or several of them one after the other."""
    if isinstance(value, str):
        return value
    if isinstance(value, (list, tuple)):
        return "".join(text(part, context) for part in value)
    performed: str = value.perform(context)
    return performed


class IfCondition:
    def __init__(self, predicate_expression: Any) -> None:
        self._expression = predicate_expression

    def evaluate(self, context: LaunchContext) -> bool:
        found = text(self._expression, context).lower()
        assert found in ("true", "1", "false", "0"), found
        return found in ("true", "1")


class DeclareLaunchArgument:
    def __init__(self, name: str, *, default_value: Any, description: str) -> None:
        self._name, self._default, self._description = name, default_value, description

    def visit(self, context: LaunchContext) -> Iterator[Process]:
        context.descriptions[self._name] = self._description
        if self._name not in context.launch_configurations:
            context.launch_configurations[self._name] = text(self._default, context)
        yield from ()


class OpaqueFunction:
    def __init__(self, *, function: Callable[[LaunchContext], Sequence[Any]]) -> None:
        self._function = function

    def visit(self, context: LaunchContext) -> Iterator[Process]:
        for entity in self._function(context):
            yield from entity.visit(context)


class PythonLaunchDescriptionSource:
    def __init__(self, launch_file_path: Any) -> None:
        self.path = launch_file_path


class IncludeLaunchDescription:
    """The included file sees the arguments of the one that includes it, as in ROS."""

    def __init__(
        self,
        launch_description_source: PythonLaunchDescriptionSource,
        *,
        launch_arguments: Iterable[tuple[str, Any]] = (),
    ) -> None:
        self._source, self._arguments = launch_description_source, list(launch_arguments)

    def visit(self, context: LaunchContext) -> Iterator[Process]:
        for name, value in self._arguments:
            context.launch_configurations[name] = text(value, context)
        yield from _description(Path(text(self._source.path, context))).visit(context)


class LaunchDescription:
    def __init__(self, initial_entities: Iterable[Any]) -> None:
        self._entities = list(initial_entities)

    def visit(self, context: LaunchContext) -> Iterator[Process]:
        for entity in self._entities:
            yield from entity.visit(context)


class Node:
    def __init__(
        self,
        *,
        package: str,
        executable: str,
        name: Any = "",
        namespace: Any = "",
        parameters: Sequence[Any] = (),
        remappings: Sequence[tuple[Any, Any]] = (),
        arguments: Sequence[Any] = (),
        output: str = "log",
        condition: IfCondition | None = None,
    ) -> None:
        assert output in ("log", "screen")
        self._package, self._executable = package, executable
        self._name, self._namespace, self._parameters = name, namespace, parameters
        self._remappings, self._arguments, self._condition = remappings, arguments, condition

    def visit(self, context: LaunchContext) -> Iterator[Process]:
        if self._condition is not None and not self._condition.evaluate(context):
            return
        values: dict[str, Any] = {}
        files: list[Path] = []
        for one in self._parameters:
            if isinstance(one, dict):
                assert one, "launch_ros writes a file for it"
                values.update(one)
            else:
                assert not values, "a file after values comes before them"
                files.append(Path(text(one, context)))
        yield Process(
            self._package,
            self._executable,
            text(self._name, context),
            text(self._namespace, context),
            tuple(files),
            values,
            {text(ours, context): text(theirs, context) for ours, theirs in self._remappings},
            tuple(text(word, context) for word in self._arguments),
        )


_MODULES = {
    "launch": (LaunchContext, LaunchDescription),
    "launch.actions": (DeclareLaunchArgument, IncludeLaunchDescription, OpaqueFunction),
    "launch.conditions": (IfCondition,),
    "launch.launch_description_sources": (PythonLaunchDescriptionSource,),
    "launch.substitutions": (LaunchConfiguration, PathJoinSubstitution),
    "launch_ros": (),
    "launch_ros.actions": (Node,),
    "launch_ros.substitutions": (FindPackageShare,),
}


@contextmanager
def _stand_in() -> Iterator[None]:
    """Instead of ROS launch, where that is installed too."""
    before = {name: sys.modules.get(name) for name in _MODULES}
    for name, classes in _MODULES.items():
        module = ModuleType(name)
        for one in classes:
            setattr(module, one.__name__, one)
        sys.modules[name] = module
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def _description(path: Path) -> LaunchDescription:
    with _stand_in():
        found: LaunchDescription = runpy.run_path(str(path))["generate_launch_description"]()
    return found


def processes(path: Path, **arguments: str) -> list[Process]:
    """What `ros2 launch PATH name:=value ...` would start."""
    context = LaunchContext(dict(arguments))
    found = list(_description(path).visit(context))
    unknown = set(arguments) - set(context.descriptions)
    assert not unknown, f"{path.name} declares no {sorted(unknown)}"
    return found


def declared(path: Path) -> dict[str, str]:
    """Description of each argument that the file, or one that it includes, declares."""
    context = LaunchContext()
    list(_description(path).visit(context))
    return context.descriptions
