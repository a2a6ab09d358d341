"""Requests on parameters, states and services that make no sense."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetLoggerLevels,
    SetParameters,
    SetParametersAtomically,
)
from std_srvs.srv import Trigger

from tests.support.faults.bench import PATIENCE, RAW, Bench
from tests.support.faults.fault import Fault
from tests.support.node_here import running_node
from tests.support.ros_graph import image_message

INTEGER, DOUBLE = 2, 3
RESETS = 115  # a second


def state(bench: Bench) -> str:
    request = GetState.Request()
    return str(bench.probe.call(GetState, "get_state", request).current_state.label)


# Parameters.


def parameter(name: str, kind: int, **content: Any) -> Parameter:
    return Parameter(name=name, value=ParameterValue(type=kind, **content))


def keeps(*parameters: Parameter) -> Callable[[Bench], str]:
    """None of them is taken, alone or atomically with a good one; the values stay."""

    def do(bench: Bench) -> str:
        before = vars(bench.node.settings).copy()
        good = parameter("min_depth", DOUBLE, double_value=0.125)
        for one in parameters:
            request = SetParameters.Request(parameters=[one])
            (result,) = bench.ask(SetParameters, "set_parameters", request).results
            whole = SetParametersAtomically.Request(parameters=[good, one])
            atomic = bench.ask(SetParametersAtomically, "set_parameters_atomically", whole).result
            assert not result.successful
            assert not atomic.successful
            assert result.reason and atomic.reason
        assert vars(bench.node.settings) == before
        return "the values in force stay"

    return do


def refuses(name: str, says: str, *parameters: Parameter) -> Fault:
    return Fault(name, keeps(*parameters), (f"answer .*{says}",), True)


def whole_number(bench: Bench) -> str:
    assert bench.set("max_depth", 5)
    assert bench.node.settings.max_depth == 5.0
    assert bench.set("max_depth", 0)
    return "taken as 5.0"


def impossible_pair(bench: Bench) -> str:
    assert bench.set("max_depth", 2.0)
    assert not bench.set("min_depth", 5.0)
    assert bench.node.settings.min_depth == 0.0
    assert bench.set("max_depth", 0.0)
    return "the values in force stay"


def questions(bench: Bench) -> str:
    names = ["nothing", "", "\n", "a" * 100_000]
    for kind, service in (
        (GetParameters, "get_parameters"),
        (DescribeParameters, "describe_parameters"),
        (GetParameterTypes, "get_parameter_types"),
    ):
        assert bench.ask(kind, service, kind.Request(names=names)) is not None
    deep = ListParameters.Request(depth=2**64 - 1, prefixes=names)
    assert not bench.ask(ListParameters, "list_parameters", deep).result.names
    levels = SetLoggerLevels.Request()
    assert bench.ask(SetLoggerLevels, "set_logger_levels", levels).results == []
    return "answered with nothing"


PARAMETERS = (
    refuses(
        "a parameter of type 77",
        "77 is not a valid .*parameters and their types: .'num_tokens': 77.",
        parameter("num_tokens", 77),
    ),
    refuses(
        "a parameter without a value",
        "num_tokens is given without a value",
        parameter("num_tokens", 0),
    ),
    refuses(
        "a list of texts for a number",
        "Wrong parameter type, expected 'Type.INTEGER' got 'Type.STRING_ARRAY'",
        parameter("num_tokens", 9, string_array_value=["a"]),
    ),
    refuses(
        "NaN and infinity for a number",
        "Parameter min_depth out of range",
        parameter("min_depth", DOUBLE, double_value=float("nan")),
        parameter("min_depth", DOUBLE, double_value=float("inf")),
    ),
    refuses(
        "num_tokens 100 000",
        "Parameter num_tokens out of range. Min: 0, Max: 4096, value: 100000",
        parameter("num_tokens", INTEGER, integer_value=100_000),
    ),
    refuses(
        "a parameter that does not exist",
        "there is no parameter 'mx_depth'; did you mean 'max_depth'.",
        parameter("mx_depth", DOUBLE, double_value=1.0),
    ),
    refuses(
        "a parameter of a camera that does not exist",
        "there is no parameter 'rear.max_gap'",
        parameter("rear.max_gap", DOUBLE, double_value=1.0),
    ),
    refuses(
        "a parameter that a camera cannot have for itself",
        "there is no parameter 'raw.queue_size'; did you mean 'queue_size'.",
        parameter("raw.queue_size", INTEGER, integer_value=3),
    ),
    refuses(
        "a parameter without a name",
        "a parameter without a name",
        parameter("", INTEGER, integer_value=1),
    ),
    refuses(
        "a name of 100 000 characters",
        r"there is no parameter 'a{40}\.\.\.'",
        parameter("a" * 100_000, INTEGER, integer_value=1),
    ),
    refuses(
        "what is fixed at start",
        "Trying to set a read-only parameter: cameras",
        parameter("cameras", 9, string_array_value=["a"]),
    ),
    refuses(
        "another model, while configured",
        "model can change only while the node is unconfigured",
        parameter("model", 4, string_value="other"),
    ),
    refuses(
        "a choice that is none",
        "distortion is 'maybe', expected one of",
        parameter("distortion", 4, string_value="maybe"),
    ),
    Fault(
        "min_depth above max_depth",
        impossible_pair,
        ("answer min_depth 5.0 must be below max_depth 2.0",),
        refused=True,
    ),
    Fault("a whole number for a decimal one", whole_number),
    Fault("questions about unknown parameters", questions),
)

# States.


def change(bench: Bench, number: int = 0, label: str = "") -> bool:
    request = ChangeState.Request()
    request.transition.id, request.transition.label = number, label
    return bool(bench.probe.call(ChangeState, "change_state", request).success)


def impossible(steps: tuple[str, ...], *asked: int | str, back: tuple[str, ...] = ()) -> Any:
    """steps: to the state in which it is asked. back: to the active one. asked: by id or label."""

    def do(bench: Bench) -> str:
        for step in steps:
            assert change(bench, label=step)
        before = state(bench)
        for one in asked:
            assert not (change(bench, one) if isinstance(one, int) else change(bench, label=one))
            assert state(bench) == before
        for step in back:
            assert change(bench, label=step)
        assert state(bench) == "active"
        return f"stays {before}"

    return do


def after_shutdown(bench: Bench) -> str:
    """Of another node: this one is needed."""
    name, since = "/other/stream_depth/change_state", len(bench.said)
    client = bench.probe.node.create_client(ChangeState, name)
    with running_node(bench.domain, ["-r", "__ns:=/other"], counted=True) as other:
        bench.probe.wait(client.service_is_ready)
        found = []
        for label in ("shutdown", "configure", "activate", "shutdown"):
            request = ChangeState.Request()
            request.transition.label = label
            future = client.call_async(request)
            bench.probe.wait(future.done, PATIENCE)
            found.append(future.result().success)
        assert found == [True, False, False, False]
        assert other._phase == "finalized"
        bench.wait_said(SAYS[0], since)  # while it can still be heard
    bench.probe.node.destroy_client(client)
    return "stays finalized"


def cycles(bench: Bench) -> str:
    for _ in range(10):
        for label in ("deactivate", "cleanup", "configure", "activate"):
            assert change(bench, label=label)
    return "active again each time"


def again(bench: Bench) -> str:
    for _ in range(10):
        for label in ("deactivate", "activate"):
            assert change(bench, label=label)
    return "active again each time"


SAYS = ("WARN .*change_state: refused: no transition .* from the present state",)
STATES = (
    Fault("activate while active", impossible((), 3), SAYS, True),
    Fault("configure while active", impossible((), 1), SAYS, True),
    Fault("clean up while active", impossible((), 2), SAYS, True),
    Fault("the shutdown of another state", impossible((), 5), SAYS, True),
    Fault("a transition that does not exist (77)", impossible((), 77, 200), SAYS, True),
    Fault(
        "a transition by a name that does not exist",
        impossible((), "nonsense", "configure"),
        ("WARN .*change_state: refused: no transition 'nonsense' from the present state",),
        True,
    ),
    Fault(
        "configure while inactive",
        impossible(("deactivate",), 1, 4, back=("activate",)),
        SAYS,
        True,
    ),
    Fault(
        "activate while unconfigured",
        impossible(("deactivate", "cleanup"), 3, 2, 4, 7, back=("configure", "activate")),
        SAYS,
        True,
        within=5,
    ),
    Fault("configure after shutdown", after_shutdown, SAYS, True),
    Fault("deactivated and activated 10 times", again, within=2),
    Fault("cleaned up and configured 10 times", cycles, within=5),
)

# The node's own services.


def chatter(bench: Bench) -> str:
    """Resets far more often than pictures come; every one is answered, and depth goes on."""
    client = bench.probe.node.create_client(Trigger, "/stream_depth/reset")
    bench.probe.wait(client.service_is_ready)
    futures, good, sent = [], 0, 0
    start = time.monotonic()
    while (now := time.monotonic() - start) < 1.0:
        while len(futures) < now * RESETS:
            futures.append(client.call_async(Trigger.Request()))
            bench.probe.spin_until(futures[-1].done, 0.002)
        image = bench.fresh()
        depth = bench.work(RAW, image_message(image))
        sent += 1
        good += depth is not None and bench.right(depth, image)
    bench.probe.wait(lambda: all(future.done() for future in futures), PATIENCE)
    assert all(future.result().success for future in futures)
    assert good == sent
    bench.probe.node.destroy_client(client)
    return "every one answered, every picture has depth"


def nothing_to_calibrate(bench: Bench) -> str:
    assert not bench.ask(Trigger, "calibrate", Trigger.Request()).success
    return "the depth stays as it is"


SERVICES = (
    Fault(
        "115 resets a second",
        chatter,
        ("WARN more than 5 resets a second are asked for",),
    ),
    Fault(
        "calibrate without measurements",
        nothing_to_calibrate,
        ("answer raw: metric_source is 'none', which measures nothing",),
        True,
    ),
)

FAULTS = (*PARAMETERS, *STATES, *SERVICES)
