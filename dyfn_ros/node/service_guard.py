"""Requests that rclpy's own services cannot answer are answered with a reason."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.lifecycle import LifecycleNode

Answer = Callable[[Any, Any], Any]


def guard_services(node: LifecycleNode, warn: Callable[[str], None]) -> None:
    """Call when the node has the services of its base classes.

    rclpy raises on lifecycle transitions that the present state does not have and on parameters
    of no known type, among others; without an answer a client waits for ever. warn: told which
    request was refused, and why.
    """
    for service in node.services:
        answer = partial(_checked, node, service.callback)
        service.callback = _guarded(service.srv_name, answer, warn)


def _checked(node: LifecycleNode, answer: Answer, request: Any, response: Any) -> Any:
    """The answer; raises where rclpy says no to the label of a transition without a word."""
    if isinstance(request, ChangeState.Request) and request.transition.label:
        node._state_machine.get_transition_by_label(request.transition.label)
    return answer(request, response)


def _guarded(name: str, answer: Answer, warn: Callable[[str], None]) -> Answer:
    def guarded(request: Any, response: Any) -> Any:
        if isinstance(request, SetParameters.Request):
            parts = [SetParameters.Request(parameters=[one]) for one in request.parameters]
            response.results = [
                result for part in parts for result in alone(part, SetParameters.Response()).results
            ]
            return response
        return alone(request, response)

    def alone(request: Any, response: Any) -> Any:
        try:
            return answer(request, response)
        except Exception as error:
            reason = _reason(request, error)
            warn(f"{name}: refused: {reason}")
            return _refusal(type(response)(), reason)

    return guarded


def _reason(request: Any, error: Exception) -> str:
    if isinstance(request, ChangeState.Request):
        wanted = request.transition.label or request.transition.id
        return f"no transition {wanted!r} from the present state"
    if isinstance(request, SetParameters.Request | SetParametersAtomically.Request):
        kinds = {one.name: one.value.type for one in request.parameters}
        return f"{error} (parameters and their types: {kinds})"
    return f"{type(error).__name__}: {error}"


def _refusal(response: Any, reason: str) -> Any:
    """The answer that says no, in a service's own words."""
    refused = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParameters.Response):
        response.results = [refused]
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = refused
    return response  # of ChangeState: success is False unless it is set
