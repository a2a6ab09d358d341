"""An executor that a callback's exception does not end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.executors import (
    ConditionReachedException,
    Executor,
    ExternalShutdownException,
    ShutdownException,
    TimeoutException,
)
from rclpy.node import Node


class NodeExecutor(Executor):
    """Runs a node's callbacks in the thread that spins.

    ended: when `spin` returns; whoever makes it true calls `wake` afterwards. failed: told what a
    callback raised; the next callback then runs as if nothing had been.
    """

    def __init__(
        self, node: Node, ended: Callable[[], bool], failed: Callable[[Exception], None]
    ) -> None:
        super().__init__(context=node.context)
        self._ended, self._failed = ended, failed
        self.add_node(node)

    def spin(self) -> None:
        """Until `ended`, or until the context ends."""
        while self.context.ok() and not self._ended():
            self.spin_once()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """One callback."""
        try:
            entity: Any
            task, entity, _ = self.wait_for_ready_callbacks(timeout_sec, None, self._ended)
        except (
            ConditionReachedException,
            ExternalShutdownException,
            ShutdownException,
            TimeoutException,
        ):
            return
        task()
        error = task.exception()
        if error is None:
            return
        if getattr(entity, "_executor_event", False):
            # The message could not even be taken: rclpy would never wait for this entity again.
            entity._executor_event = False
            entity.callback_group.ending_execution(entity)
            self.wake()
        self._failed(error)
