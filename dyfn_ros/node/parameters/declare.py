"""The parameter table on a ROS node: declared, checked and read."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from dyfn_ros.messages.encodings import quoted
from dyfn_ros.node.parameters.table import (
    CONFIGURE,
    LIMITS,
    SPECS,
    START,
    NodeSettings,
    Spec,
)

_CAMERA_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def _descriptor(spec: Spec) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(description=spec.description, read_only=spec.changes == START)
    if spec.choices:
        descriptor.additional_constraints = f"one of {', '.join(spec.choices)}"
    if spec.changes == CONFIGURE:
        text = "changes only while the node is unconfigured"
        known = descriptor.additional_constraints
        descriptor.additional_constraints = f"{known}; {text}" if known else text
    if spec.range is not None:
        low, high = spec.range
        if isinstance(spec.default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=low, to_value=high)]
    return descriptor


def _as_declared(parameter: Parameter) -> Parameter:
    """A whole number where the table has a DOUBLE (`max_depth:=5`) as that; others as they are."""
    spec = SPECS.get(parameter.name.rpartition(".")[2])
    kind = Parameter.Type
    if spec is None or not isinstance(spec.default, float) or parameter.type_ != kind.INTEGER:
        return parameter
    return Parameter(parameter.name, kind.DOUBLE, float(parameter.value))


def check(changes: Mapping[str, Any], in_force: Mapping[str, Any], configured: bool = False) -> str:
    """What the descriptors cannot say. -> why the changes are refused, or "".

    changes, in_force: values by name, for the whole node or for one camera, without its name.
    """
    for name, value in changes.items():
        spec = SPECS.get(name)
        if spec is None:
            continue
        if spec.choices and value not in spec.choices:
            return f"{name} is {value!r}, expected one of {spec.choices}"
        if configured and spec.changes == CONFIGURE:
            return f"{name} can change only while the node is unconfigured (see `ros2 lifecycle`)"
    values = {**in_force, **changes}
    for low, high in LIMITS:
        if values.get(high) and values.get(low, 0.0) >= values[high]:
            return f"{low} {values[low]} must be below {high} {values[high]}"
    return ""


def check_cameras(names: Sequence[str]) -> str:
    """-> why these are no names of cameras, or ""."""
    if list(names) == [""]:
        return ""
    if not names:
        return "cameras is empty, expected at least one name"
    for name in names:
        if not _CAMERA_NAME.fullmatch(name):
            return f"cameras has {name!r}, expected letters, digits and _ after a first letter"
        if name in SPECS or name in ("depth", "points", "qos_overrides"):
            return f"cameras has {name!r}, which is the name of something else"
    if len(set(names)) < len(names):
        return f"cameras names one twice: {list(names)}"
    return ""


def _no_such(name: str) -> str:
    near = difflib.get_close_matches(name[:100], SPECS, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"there is no parameter {quoted(name)}{hint}"


class NodeParameters:
    """Declares the table on a node and keeps the settings up to date.

    A value for one camera, `CAMERA.NAME`, is declared when it is given, at start or later; without
    it the node's value is in force. A whole number is taken for a DOUBLE as well. configured:
    whether CONFIGURE parameters are fixed just now.
    Raises rclpy's InvalidParameterValueException or InvalidParameterTypeException when a value
    given at start is not allowed.
    """

    def __init__(self, node: Node, configured: Callable[[], bool] = lambda: False) -> None:
        self._node = node
        self._configured = configured
        self._own: dict[str, dict[str, str]] = {}
        node.add_on_set_parameters_callback(self._check)
        given = node._parameter_overrides
        given.update({one.name: one for one in map(_as_declared, given.values())})
        for name, spec in SPECS.items():
            node.declare_parameter(name, spec.default, _descriptor(spec))
        self.settings = self._read("")
        if reason := check_cameras(self.settings.cameras):
            raise InvalidParameterValueException("cameras", self.settings.cameras, reason)
        for camera in self.settings.cameras:
            self._own[camera] = self._declare_own(camera)
        self._by_camera = {camera: self._read(camera) for camera in self._own}
        node.add_post_set_parameters_callback(self._changed)

    def camera(self, name: str) -> NodeSettings:
        """The settings of one camera."""
        return self._by_camera[name]

    def unused(self) -> list[str]:
        """Why what was given at start has no effect: ROS passes over names that it does not know.

        Overrides of QoS are not looked at: see NodeTopics.unused_overrides.
        """
        found = []
        for name in self._node._parameter_overrides:
            if self._node.has_parameter(name) or name.startswith("qos_overrides."):
                continue
            camera, _, own = name.partition(".")
            if own in SPECS:
                listed = [one for one in self.settings.cameras if one]
                reason = f"there is no camera {quoted(camera)}; cameras is {listed}"
            else:
                reason = _no_such(name)
            found.append(f"{name} was given and has no effect: {reason}")
        return found

    def set(
        self,
        changes: Sequence[Parameter],
        on_node: Callable[[list[Parameter]], SetParametersResult],
    ) -> SetParametersResult:
        """Set parameters on the node, those of one camera too that have not been given before.

        on_node: sets what is declared, all or nothing; what it raises, this raises.
        """
        if reason := self._senseless(changes):
            return SetParametersResult(successful=False, reason=reason)
        new = list(dict.fromkeys(one.name for one in changes if self._is_new(one.name)))
        for full in new:
            camera, _, name = full.partition(".")
            self._node.declare_parameter(
                full, getattr(self.camera(camera), name), _descriptor(SPECS[name])
            )
            self._own[camera][name] = full
        result = SetParametersResult(successful=False)
        try:
            result = on_node([_as_declared(one) for one in changes])
        finally:
            if not result.successful:
                for full in new:
                    camera, _, name = full.partition(".")
                    del self._own[camera][name]
                    self._node.undeclare_parameter(full)
        return result

    def _senseless(self, changes: Sequence[Parameter]) -> str:
        """-> which of these is no parameter, or has no value, or "". (rclpy does not name it.)"""
        for name, kind in ((one.name, one.type_) for one in changes):
            if not name:
                return "a parameter without a name"
            if not self._node.has_parameter(name) and not self._is_new(name):
                return _no_such(name)
            if kind == Parameter.Type.NOT_SET:
                return f"{name} is given without a value"
        return ""

    def _is_new(self, full: str) -> bool:
        """Whether it is a setting that a camera may have for itself, and has not."""
        camera, _, name = full.partition(".")
        spec = SPECS.get(name)
        own = self._own.get(camera) if camera else None
        return spec is not None and spec.per_camera and own is not None and name not in own

    def _declare_own(self, camera: str) -> dict[str, str]:
        """Parameter by setting, for the settings that this camera has for itself."""
        given = self._node._parameter_overrides if camera else {}
        own: dict[str, str] = {}
        for full in given:
            prefix, _, name = full.partition(".")
            if prefix != camera:
                continue
            spec = SPECS.get(name)
            if spec is None or not spec.per_camera:
                reason = "no parameter that a camera has for itself"
                raise InvalidParameterValueException(full, given[full].value, reason)
            self._node.declare_parameter(full, spec.default, _descriptor(spec))
            own[name] = full
        values = {name: self._node.get_parameter(full).value for name, full in own.items()}
        if reason := check(values, vars(self.settings)):
            raise InvalidParameterValueException(camera, str(values), f"{camera}: {reason}")
        return own

    def _read(self, camera: str) -> NodeSettings:
        own = self._own.get(camera, {})
        values = {name: self._node.get_parameter(own.get(name, name)).value for name in SPECS}
        return NodeSettings(**values)

    def _check(self, changes: Sequence[Parameter]) -> SetParametersResult:
        declared = {
            name: self._node.get_parameter(name).value
            for name in SPECS
            if self._node.has_parameter(name)
        }
        values = {parameter.name: parameter.value for parameter in changes}
        reason = check(values, declared, self._configured())
        for own in self._own.values():
            special = {name: full for name, full in own.items() if self._node.has_parameter(full)}
            now = {name: self._node.get_parameter(full).value for name, full in special.items()}
            new = {name: values[full] for name, full in own.items() if full in values}
            shared = {name: value for name, value in values.items() if name not in own}
            reason = reason or check({**shared, **new}, {**declared, **now}, self._configured())
        return SetParametersResult(successful=not reason, reason=reason)

    def _changed(self, _: Sequence[Parameter]) -> None:
        self.settings = self._read("")
        self._by_camera = {camera: self._read(camera) for camera in self._own}
