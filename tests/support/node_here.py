"""A node in this process: its parameters and topics without the seconds of another process."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import rclpy
from rclpy.context import Context
from rclpy.lifecycle import TransitionCallbackReturn

from dyfn_core.models.base import GeometryModel
from dyfn_ros.node.executor import NodeExecutor
from dyfn_ros.node.node import StreamDepthNode
from tests.support.pinhole import PinholeModel
from tests.support.ros_graph import DEADLINE

SUCCESS = TransitionCallbackReturn.SUCCESS


def pinhole(name: str, device: str) -> GeometryModel:
    return PinholeModel().eval()


@contextmanager
def made_node(
    domain: dict[str, str],
    arguments: Sequence[str] = (),
    load: Callable[[str, str], GeometryModel] = pinhole,
) -> Iterator[StreamDepthNode]:
    """Unconfigured. arguments: what a command line has after --ros-args."""
    context = Context()
    line = ["stream_depth", "--ros-args", *arguments]
    rclpy.init(args=line, context=context, domain_id=int(domain["ROS_DOMAIN_ID"]))
    node = StreamDepthNode(load, context=context)
    try:
        yield node
    finally:
        node.close()
        context.try_shutdown()


@contextmanager
def running_node(
    domain: dict[str, str],
    arguments: Sequence[str] = (),
    load: Callable[[str, str], GeometryModel] = pinhole,
    counted: bool = False,
) -> Iterator[StreamDepthNode]:
    """Active; a thread runs its callbacks.

    counted: callbacks that raise are told to the node, as its process does; else none may.
    """
    ended, failures = threading.Event(), list[Exception]()
    with made_node(domain, arguments, load) as node:
        assert node.trigger_configure() == SUCCESS
        assert node.trigger_activate() == SUCCESS
        failed = node.callback_failed if counted else failures.append
        executor = NodeExecutor(node, ended.is_set, failed)
        thread = threading.Thread(target=executor.spin)
        thread.start()
        try:
            yield node
        finally:
            ended.set()
            executor.wake()
            thread.join(DEADLINE)
            executor.shutdown()
    assert not failures
