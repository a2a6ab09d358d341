"""The node's executor: it ends when it is asked, and at nothing else."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from dyfn_ros.node.executor import NodeExecutor
from tests.support.ros_graph import DEADLINE, own_domain


class Spinning:
    """A node, and a thread that spins it until the end is asked for."""

    def __init__(self, node: Node) -> None:
        self.node, self.ended = node, threading.Event()
        self.failures: list[Exception] = []
        self.executor = NodeExecutor(node, self.ended.is_set, self.failures.append)
        self.thread = threading.Thread(target=self.executor.spin)
        self.thread.start()

    def end(self) -> None:
        self.ended.set()
        self.executor.wake()
        self.thread.join(DEADLINE)
        assert not self.thread.is_alive()
        self.executor.shutdown()


@pytest.fixture
def node() -> Iterator[Node]:
    with own_domain() as environment:
        context = Context()
        rclpy.init(context=context, domain_id=int(environment["ROS_DOMAIN_ID"]))
        node = rclpy.create_node("spinner", context=context, enable_rosout=False)
        yield node
        node.destroy_node()
        context.try_shutdown()


def test_an_end_that_is_asked_for_is_not_missed(node: Node) -> None:
    for _ in range(50):
        spinning = Spinning(node)
        spinning.executor.wake()  # for nothing: it must go on waiting
        spinning.end()
        assert not spinning.failures


def wait(condition: Any) -> None:
    deadline = threading.Event()
    for _ in range(int(DEADLINE / 0.01)):
        if condition():
            return
        deadline.wait(0.01)
    raise AssertionError("waited in vain")


def test_callbacks_that_raise_are_told_and_the_others_run(node: Node) -> None:
    ticks, heard = [], []

    def tick() -> None:
        ticks.append(1)
        raise ZeroDivisionError("tick")

    def hear(message: String) -> None:
        heard.append(message.data)
        raise KeyError(message.data)

    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        raise LookupError("answer")

    node.create_timer(0.005, tick)
    node.create_subscription(String, "said", hear, 10)
    publisher = node.create_publisher(String, "said", 10)
    node.create_service(Trigger, "asked", answer)
    client = node.create_client(Trigger, "asked")
    spinning = Spinning(node)
    client.call_async(Trigger.Request())
    wait(publisher.get_subscription_count)
    publisher.publish(String(data="one"))
    publisher.publish(String(data="two"))
    wait(lambda: heard == ["one", "two"] and len(ticks) > 5)
    kinds = {ZeroDivisionError, KeyError, LookupError}
    wait(lambda: {type(error) for error in spinning.failures} == kinds)
    spinning.end()


def test_a_message_that_cannot_be_taken_does_not_make_a_topic_deaf(
    node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: list[str] = []
    subscription = node.create_subscription(String, "said", lambda m: heard.append(m.data), 10)
    publisher = node.create_publisher(String, "said", 10)
    take = NodeExecutor._take_subscription
    broken = [True]

    def take_one(self: NodeExecutor, entity: Any) -> Any:
        taken = take(self, entity)
        if broken:
            broken.pop()
            raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "what a wire may carry")
        return taken

    monkeypatch.setattr(NodeExecutor, "_take_subscription", take_one)
    spinning = Spinning(node)
    wait(publisher.get_subscription_count)
    publisher.publish(String(data="broken"))
    wait(lambda: spinning.failures)
    publisher.publish(String(data="whole"))
    wait(lambda: heard == ["whole"])
    spinning.end()
    assert [type(error) for error in spinning.failures] == [UnicodeDecodeError]
    node.destroy_subscription(subscription)
