"""What one parameter of the node is; table.py has them all."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from dyfn_core.stream.options import Option

Value = str | bool | int | float | list[str]

START = "start"  # read only
CONFIGURE = "configure"  # while the node is unconfigured
RUN = "run"  # at any time
MARKS = {START: "*", CONFIGURE: "+", RUN: ""}


@dataclass(frozen=True)
class Spec:
    """One parameter.

    group: heading in the manual. changes: START, CONFIGURE or RUN. per_camera: a named camera may
    have a value of its own, `CAMERA.NAME`. range: both ends are allowed. choices: for strings.
    """

    default: Value
    description: str
    group: str
    changes: str = CONFIGURE
    per_camera: bool = False
    range: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()


def parameter(group: str, default: Value, description: str, **options: Any) -> Any:
    spec = Spec(default, description, group, **options)
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata={"spec": spec})
    return field(default=default, metadata={"spec": spec})


def spec_of(entry: Any) -> Spec:
    """Of a field made by `parameter`, or by a stream's `option`: those a camera may have itself."""
    if "spec" in entry.metadata:
        spec: Spec = entry.metadata["spec"]
        return spec
    option: Option = entry.metadata["option"]
    default: Value = entry.default
    return Spec(
        default,
        option.description,
        option.group,
        changes=RUN if option.live else CONFIGURE,
        per_camera=True,
        range=option.range,
        choices=option.choices,
    )
