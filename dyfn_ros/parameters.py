"""The node's parameters: one table, from which they are declared, checked and read."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args


@dataclass(frozen=True)
class Spec:
    """One parameter. range: both ends are allowed values. choices: for strings."""

    default: str | bool | int | float
    description: str
    read_only: bool = True
    range: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()


SPECS: dict[str, Spec] = {
    "model": Spec("dyfn-mini", "Bundled model's name, checkpoint file, or Hub id."),
    "device": Spec("auto", "Where to run: auto (a GPU if there is one), cpu, cuda, cuda:N."),
    "threads": Spec(0, "CPU threads for inference; 0 leaves the default.", range=(0, 1024)),
    "image_transport": Spec(
        "raw",
        "raw subscribes `image`, compressed subscribes `image/compressed`.",
        choices=("raw", "compressed"),
    ),
    "reliability": Spec(
        "auto",
        "Of the subscriptions; auto is reliable when drop_frames is false, else best effort, "
        "which every camera driver matches.",
        choices=("auto", "best_effort", "reliable"),
    ),
    "drop_frames": Spec(
        True,
        "Work on the latest frame and drop those that came meanwhile. False: queue and work on "
        "every frame in order, for recordings.",
    ),
    "queue_size": Spec(
        1000, "Frames that may wait when drop_frames is false.", range=(1, 1_000_000)
    ),
    "wait_for_camera_info": Spec(
        False, "Hold the first frames until a CameraInfo has come, so that all have intrinsics."
    ),
    "rectified": Spec(False, "The images are rectified: take P of the CameraInfo instead of K."),
    "stabilize": Spec(True, "Use DyFN. A change starts the stream anew.", read_only=False),
    "num_tokens": Spec(
        0,
        "Resolution inside the model; 0 is the model's own. A change starts the stream anew.",
        read_only=False,
        range=(0, 100_000),
    ),
    "publish_depth": Spec(True, "Publish ~/depth when somebody subscribes.", read_only=False),
    "publish_points": Spec(True, "Publish ~/points when somebody subscribes.", read_only=False),
    "min_depth": Spec(
        0.0,
        "Nearer points become NaN; in the unit of the output depth.",
        read_only=False,
        range=(0.0, 1e6),
    ),
    "max_depth": Spec(
        0.0,
        "Farther points become NaN; in the unit of the output depth; 0 is no limit.",
        read_only=False,
        range=(0.0, 1e6),
    ),
}


@dataclass(frozen=True)
class Settings:
    """The values in force; a new one for each change."""

    model: str
    device: str
    threads: int
    image_transport: str
    reliability: str
    drop_frames: bool
    queue_size: int
    wait_for_camera_info: bool
    rectified: bool
    stabilize: bool
    num_tokens: int
    publish_depth: bool
    publish_points: bool
    min_depth: float
    max_depth: float

    @property
    def reliable(self) -> bool:
        if self.reliability == "auto":
            return not self.drop_frames
        return self.reliability == "reliable"


def usage(arguments: Sequence[str]) -> None:
    """Take what is not for ROS from the command line: --help, or an error that ends the program.

    arguments: with the program's name first.
    """
    lines = [
        f"  {name:22}{spec.description} [{str(spec.default).lower()}]"
        for name, spec in SPECS.items()
    ]
    parser = argparse.ArgumentParser(
        prog="stream_depth",
        usage="stream_depth [--ros-args -r image:=TOPIC -r camera_info:=TOPIC -p NAME:=VALUE ...]",
        description="Images in, depth and clouds out. Parameters and [defaults]:",
        epilog="\n".join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.parse_args(remove_ros_args(list(arguments))[1:])


def _descriptor(spec: Spec) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=spec.description, read_only=spec.read_only)
    if spec.choices:
        descriptor.additional_constraints = f"one of {', '.join(spec.choices)}"
    if spec.range is not None:
        low, high = spec.range
        if isinstance(spec.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor


def check(changes: Sequence[Parameter], depths: tuple[float, float]) -> SetParametersResult:
    """What the descriptors cannot say. depths: min_depth and max_depth in force."""
    near, far = depths
    for parameter in changes:
        spec = SPECS.get(parameter.name)
        if spec and spec.choices and parameter.value not in spec.choices:
            return SetParametersResult(
                successful=False,
                reason=f"{parameter.name} is {parameter.value!r}, expected one of {spec.choices}",
            )
        near = parameter.value if parameter.name == "min_depth" else near
        far = parameter.value if parameter.name == "max_depth" else far
    if far and near >= far:
        return SetParametersResult(
            successful=False, reason=f"min_depth {near} must be below max_depth {far}"
        )
    return SetParametersResult(successful=True)


class NodeParameters:
    """Declares the table on a node and keeps `settings` up to date.

    Raises rclpy's InvalidParameterValueException or InvalidParameterTypeException when a value
    given at start is not allowed.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        node.add_on_set_parameters_callback(self._check)
        for name, spec in SPECS.items():
            node.declare_parameter(name, spec.default, _descriptor(spec))
        self.settings = self._read()
        node.add_post_set_parameters_callback(self._changed)

    def _read(self) -> Settings:
        return Settings(**{name: self._node.get_parameter(name).value for name in SPECS})

    def _check(self, changes: Sequence[Parameter]) -> SetParametersResult:
        declared = ("min_depth", "max_depth")
        near, far = (
            self._node.get_parameter(name).value if self._node.has_parameter(name) else 0.0
            for name in declared
        )
        return check(changes, (near, far))

    def _changed(self, _: Sequence[Parameter]) -> None:
        self.settings = self._read()
