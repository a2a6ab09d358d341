"""Work on files beside the executor: a slow disk delays the one who asked, and nobody else."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.task import Future


class FileWork:
    """One piece of work at a time, in threads that no end of the process waits for."""

    def __init__(self) -> None:
        self._turn = threading.Lock()

    def run(self, work: Callable[[], str], executor: Any) -> Future:
        """What the executor's callback awaits: the result of `work`, or its exception."""
        future = Future(executor=executor)

        def run() -> None:
            with self._turn:
                try:
                    future.set_result(work())
                except Exception as error:
                    future.set_exception(error)
            if executor is not None:
                executor.wake()

        threading.Thread(target=run, name="files", daemon=True).start()
        return future
