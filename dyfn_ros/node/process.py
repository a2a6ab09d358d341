"""What a process with the node does between its start and its end."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import try_shutdown

from dyfn_core.models import load_model
from dyfn_ros.node.end_request import EndRequest
from dyfn_ros.node.executor import NodeExecutor
from dyfn_ros.node.node import ModelLoader, StreamDepthNode


def run(args: Sequence[str], load: ModelLoader | None, end: EndRequest) -> int:
    """Until a signal asks for the end. -> exit code.

    args: the command line, the program's name first. load: None is load_model.
    """
    end.open()
    try:
        # rclpy's own handlers wake an executor before they end its context: it may miss the end.
        rclpy.init(args=list(args), signal_handler_options=SignalHandlerOptions.NO)
        node = StreamDepthNode(load or load_model, ending=end.asked)
    except (ParameterException, RuntimeError) as error:  # RuntimeError: what rcl does not accept
        print(f"stream_depth: {error}", file=sys.stderr)
        return 0 if end.asked() else 1
    try:
        code = _serve(node, end)
    finally:
        done = node.close()
        try_shutdown()
    if not done:  # a model that is still loading: the interpreter cannot end under its thread
        end.leave(code)
    return code


def _serve(node: StreamDepthNode, end: EndRequest) -> int:
    """-> exit code."""
    if node.settings.autostart and not _autostart(node):
        if end.asked():
            return 0
        node.get_logger().fatal("cannot run: autostart failed")
        return 1
    executor = NodeExecutor(node, end.asked, node.callback_failed)
    end.wake_with(executor.wake)
    try:
        executor.spin()
    finally:
        executor.shutdown()
    return 0


def _autostart(node: StreamDepthNode) -> bool:
    """Configure and activate. -> whether that worked; the node logs why not."""
    success = TransitionCallbackReturn.SUCCESS
    configured = node.trigger_configure() == success
    return bool(configured and node.trigger_activate() == success)
