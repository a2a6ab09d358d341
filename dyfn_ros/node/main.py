"""The command `stream_depth`: the node in a process of its own."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import uninstall_signal_handlers
from rclpy.utilities import try_shutdown

from dyfn_ros.node.environment import prepare_environment
from dyfn_ros.node.parameters.declare import usage

if TYPE_CHECKING:
    from dyfn_ros.node.node import ModelLoader, StreamDepthNode


def _make(args: Sequence[str] | None, load: ModelLoader | None) -> StreamDepthNode | None:
    """The node; None, and the reason on stderr, when ROS or the parameters do not allow one."""
    try:
        usage(sys.argv if args is None else args)
        # Imports that take seconds, here where `main` knows what an interrupt means.
        from dyfn_core.models import load_model
        from dyfn_ros.node.node import StreamDepthNode

        rclpy.init(args=None if args is None else list(args))
        return StreamDepthNode(load or load_model)
    except (ParameterException, RuntimeError) as error:  # RuntimeError: what rcl does not accept
        print(f"stream_depth: {error}", file=sys.stderr)
        return None


def _autostart(node: StreamDepthNode) -> bool:
    """Configure and activate. -> whether that worked; the node logs why not."""
    success = TransitionCallbackReturn.SUCCESS
    try:
        configured = node.trigger_configure() == success
        return bool(configured and node.trigger_activate() == success)
    except RuntimeError:  # the state machine cannot publish into a context that has ended
        if node.context.ok():
            raise
        return False


def _run(node: StreamDepthNode) -> int:
    """Until the context ends. -> exit code."""
    if node.settings.autostart and not _autostart(node):
        if node.context.ok():
            node.get_logger().fatal("cannot run: autostart failed")
            return 1
        return 0  # interrupted
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        executor.spin()
    except RuntimeError:  # a callback that published into a context that had just ended
        if node.context.ok():
            raise
    finally:
        uninstall_signal_handlers()  # their thread still touches the executor's guard conditions
        executor.shutdown()
    return 0


def main(args: Sequence[str] | None = None, load: ModelLoader | None = None) -> int:
    """-> exit code: 0 after SIGINT or SIGTERM, 1 when the node cannot run.

    args: the command line; None takes sys.argv. load: (name, device) -> model; None is load_model.
    """
    prepare_environment()
    node: StreamDepthNode | None = None
    code = 0
    try:
        node = _make(args, load)
        code = 1 if node is None else _run(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    done = node is None or node.close()
    try_shutdown()
    if not done:  # a download, or a huge model: the interpreter cannot end under a running thread
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
