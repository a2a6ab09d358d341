"""No request ends or blocks the node: it is refused with a reason, and the node goes on."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from tests.support.probe import Probe, stamped
from tests.support.ros_graph import NodeProcess, frames, image_message, own_domain, tiny_node


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[NodeProcess, Probe]]:
    with own_domain() as environment:
        folder = tmp_path_factory.mktemp("node")
        node = tiny_node(environment, folder, state_file=str(folder / "state.safetensors"))
        probe = Probe(environment)
        yield node, probe
        code = node.end()
        probe.close()
        assert code == 0, node.log
        assert "Traceback" not in node.log


def transition(number: int, label: str = "") -> ChangeState.Request:
    request = ChangeState.Request()
    request.transition.id, request.transition.label = number, label
    return request


# By state: what a state machine cannot do from there.
IMPOSSIBLE = {
    "active": [transition(1), transition(3), transition(2), transition(5), transition(77)],
    "inactive": [transition(1), transition(4), transition(0, "nonsense"), transition(200)],
    "unconfigured": [transition(3), transition(2), transition(4), transition(7)],
}


@pytest.mark.parametrize("state", IMPOSSIBLE)
def test_transitions_that_the_state_does_not_have_are_refused(
    running: tuple[NodeProcess, Probe], state: str
) -> None:
    node, probe = running
    for step in {"active": (), "inactive": ("deactivate",), "unconfigured": ("cleanup",)}[state]:
        assert probe.change(step)
    assert probe.state() == state
    for request in IMPOSSIBLE[state]:
        assert not probe.call(ChangeState, "change_state", request).success
        assert probe.state() == state
    node.wait_log(r"WARN\].*change_state: refused: no transition")


def test_the_refused_transitions_left_nothing_behind(running: tuple[NodeProcess, Probe]) -> None:
    _, probe = running
    assert probe.state() == "unconfigured"
    assert probe.change("configure")
    assert probe.change("activate")
    assert probe.state() == "active"


def value(kind: int, **content: Any) -> ParameterValue:
    return ParameterValue(type=kind, **content)


BAD = [
    Parameter(name="num_tokens", value=value(77)),
    Parameter(name="num_tokens", value=value(255, integer_value=1)),
    Parameter(name="num_tokens", value=value(0)),
    Parameter(name="num_tokens", value=value(9, string_array_value=["a"])),
    Parameter(name="min_depth", value=value(3, double_value=float("nan"))),
    Parameter(name="", value=value(2, integer_value=1)),
    Parameter(name="a" * 100_000, value=value(2, integer_value=1)),
    Parameter(name="use_sim_time", value=value(200)),
]


@pytest.mark.parametrize("parameter", BAD, ids=lambda one: f"{one.name[:12]}-{one.value.type}")
def test_parameters_of_impossible_types_and_names_are_refused(
    running: tuple[NodeProcess, Probe], parameter: Parameter
) -> None:
    _, probe = running
    good = Parameter(name="min_depth", value=value(3, double_value=0.5))
    request = SetParameters.Request(parameters=[parameter, good])
    bad_result, good_result = probe.call(SetParameters, "set_parameters", request).results
    assert (bad_result.successful, good_result.successful) == (False, True)
    assert bad_result.reason
    whole = SetParametersAtomically.Request(parameters=[good, parameter])
    answer = probe.call(SetParametersAtomically, "set_parameters_atomically", whole)
    assert not answer.result.successful
    assert answer.result.reason


def test_questions_about_what_is_not_there_are_answered(
    running: tuple[NodeProcess, Probe],
) -> None:
    _, probe = running
    for kind, name, request in [
        (DescribeParameters, "describe_parameters", DescribeParameters.Request(names=["no", ""])),
        (GetParameters, "get_parameters", GetParameters.Request(names=["no", "\n"])),
        (ListParameters, "list_parameters", ListParameters.Request(depth=2**64 - 1)),
    ]:
        assert probe.call(kind, name, request) is not None
    assert probe.state() == "active"


def test_limits_are_refused_at_once(running: tuple[NodeProcess, Probe]) -> None:
    node, probe = running
    assert not probe.set("num_tokens", 100_000).successful
    assert probe.set("max_megapixels", 0.05).successful
    publisher = probe.node.create_publisher(Image, "/image", 10)
    probe.wait(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(stamped(image_message(frames(1, 300, 300)[0]), 1))
    node.wait_log(r"WARN\].*/image: the picture says that it is 300 x 300 pixels; at most 52429 ")
    publisher.publish(stamped(image_message(frames(1)[0]), 2))
    saved = save(probe)
    probe.wait(lambda: saved("save_state").success)


def save(probe: Probe) -> Callable[[str], Trigger.Response]:
    return lambda name: probe.call(Trigger, name, Trigger.Request())


def test_state_files_that_are_none_are_refused_and_nothing_is_overwritten(
    running: tuple[NodeProcess, Probe], tmp_path: Path
) -> None:
    node, probe = running
    folder = node.log_path.parent
    text, pipe = folder / "text", folder / "pipe"
    text.write_text("of somebody else")
    os.mkfifo(pipe)
    for path, action, reason in (
        (text, "save_state", "is no state file, it is not replaced"),
        (text, "load_state", "no state file"),
        (pipe, "save_state", "no regular file"),
        (pipe, "load_state", "no regular file"),
        (tmp_path / "elsewhere", "save_state", "outside of the folder for state files"),
        (folder / ".." / "up", "load_state", "outside of the folder for state files"),
        (Path("/dev/full"), "save_state", "outside of the folder for state files"),
    ):
        assert probe.set("state_file", str(path)).successful
        answer = save(probe)(action)
        assert not answer.success
        assert reason in answer.message
    assert text.read_text() == "of somebody else"
    assert probe.state() == "active"
