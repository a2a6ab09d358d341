"""A client of any topics and services of a node in another process."""

from __future__ import annotations

import os
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from tests.support.ros_graph import DEADLINE, NODE, RELIABLE


class Probe:
    """Publishes, subscribes and calls; everything waits for an event with a deadline."""

    def __init__(self, environment: dict[str, str], name: str = "probe") -> None:
        os.environ.update(environment)
        self.context = Context()
        rclpy.init(context=self.context, domain_id=int(environment["ROS_DOMAIN_ID"]))
        self.node = rclpy.create_node(name, context=self.context, enable_rosout=False)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self._publishers: dict[str, Any] = {}
        self._clients: dict[str, Any] = {}

    def wait(self, condition: Callable[[], Any], seconds: float = DEADLINE) -> Any:
        """Until the condition is true; -> its value."""
        deadline = time.monotonic() + seconds
        while not (value := condition()):
            assert time.monotonic() < deadline, f"waited {seconds} s in vain"
            self.executor.spin_once(timeout_sec=0.02)
        return value

    def spin_until(self, condition: Callable[[], Any], seconds: float) -> None:
        """Until the condition is true, or so long."""
        deadline = time.monotonic() + seconds
        while not condition() and time.monotonic() < deadline:
            self.executor.spin_once(timeout_sec=0.02)

    def listen(self, topic: str, kind: type, qos: QoSProfile = RELIABLE) -> list[Any]:
        """-> the messages so far; grows while this object waits."""
        name = topic if topic.startswith("/") else f"{NODE}/{topic}"
        take = self.received[topic].append
        self.node.create_subscription(kind, name, take, qos)
        return self.received[topic]

    def publish(self, topic: str, message: Any, qos: QoSProfile = RELIABLE) -> None:
        """On a topic that somebody subscribes; waits until somebody does."""
        publisher = self._publishers.get(topic)
        if publisher is None:
            publisher = self.node.create_publisher(type(message), topic, qos)
            self._publishers[topic] = publisher
        self.wait(lambda: publisher.get_subscription_count() >= 1)
        publisher.publish(message)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """A service of the node."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, f"{NODE}/{name}")
            self._be_known()
        client = self._clients[name]
        self.wait(client.service_is_ready)
        future = client.call_async(request)
        self.wait(future.done)
        return future.result()

    def _be_known(self) -> None:
        """Until the node has seen all of our endpoints; else DDS may lose its answer to us.

        They are announced in order: who answers a client made now has seen those made before.
        """
        client = self.node.create_client(GetState, f"{NODE}/get_state")
        self.wait(client.service_is_ready)
        futures: list[Any] = []

        def answered() -> bool:
            return any(future.done() for future in futures)

        deadline = time.monotonic() + DEADLINE
        while not answered():
            assert time.monotonic() < deadline, "the node does not answer"
            futures.append(client.call_async(GetState.Request()))
            self.spin_until(answered, 10.0)
        self.node.destroy_client(client)

    def trigger(self, name: str) -> Trigger.Response:
        return self.call(Trigger, name, Trigger.Request())

    def set(self, name: str, value: Any) -> Any:
        message = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[message])
        return self.call(SetParameters, "set_parameters", request).results[0]

    def change(self, transition: str) -> bool:
        """A lifecycle transition by its label; -> whether it worked."""
        request = ChangeState.Request()
        request.transition.label = transition
        return self.call(ChangeState, "change_state", request).success

    def state(self) -> str:
        return self.call(GetState, "get_state", GetState.Request()).current_state.label

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


def stamped(message: Image | CameraInfo, nanoseconds: int, frame_id: str = "optical") -> Any:
    """The message with a header."""
    message.header = Header(frame_id=frame_id)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
    return message


def stamp_of(message: Any) -> int:
    """Nanoseconds."""
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def statuses(message: DiagnosticArray) -> dict[str, tuple[str, dict[str, str]]]:
    """By name: message and values."""
    return {s.name: (s.message, {v.key: v.value for v in s.values}) for s in message.status}
