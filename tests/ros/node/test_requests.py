"""No request ends or blocks the node: it is refused with a reason, and the node goes on."""

from __future__ import annotations

from collections.abc import Iterator
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

from tests.support.probe import Probe
from tests.support.ros_graph import NodeProcess, own_domain, tiny_node


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[NodeProcess, Probe]]:
    with own_domain() as environment:
        node = tiny_node(environment, tmp_path_factory.mktemp("node"))
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
