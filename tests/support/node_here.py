"""A node in this process: its parameters and topics without the seconds of another process."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
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
def made_node(domain: dict[str, str], arguments: Sequence[str] = ()) -> Iterator[StreamDepthNode]:
    """Unconfigured. arguments: what a command line has after --ros-args."""
    context = Context()
    line = ["stream_depth", "--ros-args", *arguments]
    rclpy.init(args=line, context=context, domain_id=int(domain["ROS_DOMAIN_ID"]))
    node = StreamDepthNode(pinhole, context=context)
    try:
        yield node
    finally:
        node.close()
        context.try_shutdown()


@contextmanager
def running_node(
    domain: dict[str, str], arguments: Sequence[str] = ()
) -> Iterator[StreamDepthNode]:
    """Active, with the pinhole model; a thread runs its callbacks, and none of them failed."""
    ended, failures = threading.Event(), list[Exception]()
    with made_node(domain, arguments) as node:
        assert node.trigger_configure() == SUCCESS
        assert node.trigger_activate() == SUCCESS
        executor = NodeExecutor(node, ended.is_set, failures.append)
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
