"""The live node as a child process that never outlives its parent's work."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

NODE_COMMAND = (sys.executable, "-m", "dyfn_ros.node.main")
TAIL_LINES = 15
PATIENCE = (10.0, 5.0)  # seconds after SIGINT, after SIGTERM; then SIGKILL


class LiveError(Exception):
    """The node failed, did not answer, or answered wrongly; the message says what happened."""


class NodeExitError(LiveError):
    """The node ended before its work was done; the message holds the end of its log."""


class NodeProcess:
    """Starts the node; as a context manager, stops it whatever happens.

    log: file that takes its output. parameters: ROS parameters by name. namespace: of its topics
    and services; one that nobody else has keeps it apart from other nodes on the same network.
    """

    def __init__(
        self,
        log: Path,
        parameters: Mapping[str, Any],
        namespace: str = "/",
        command: Sequence[str] = NODE_COMMAND,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        self.log = log
        arguments = [*command, "--ros-args", "-r", f"__ns:={namespace}"]
        for name, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            arguments += ["-p", f"{name}:={text}"]
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                arguments,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **(environment or {})},
                start_new_session=True,  # Ctrl-C is for the parent, which then ends the node
            )

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._process.pid

    def check(self) -> None:
        """Raises NodeExitError when the node has ended."""
        code = self._process.poll()
        if code is None:
            return
        lines = self.log.read_text(errors="replace").strip().splitlines()[-TAIL_LINES:]
        raise NodeExitError(
            f"the node ended with code {code}; the end of {self.log}:\n" + "\n".join(lines)
        )

    def stop(self) -> int:
        """End the node, politely first; -> its exit code."""
        for number, patience in zip((signal.SIGINT, signal.SIGTERM), PATIENCE, strict=True):
            if self._process.poll() is None:
                self._process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                return self._process.wait(patience)
        self._process.kill()
        return self._process.wait()

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
