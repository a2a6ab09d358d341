"""SIGINT and SIGTERM as a request to end, from the first line of a process to its last."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
BOUND = 4.5  # seconds from the first signal to the end; ROS launch sends the next after 5


class EndRequest:
    """Takes the signals of this process away from everybody else.

    No handler runs, so nothing is interrupted half way, neither Python by a KeyboardInterrupt nor
    rclpy: the signals are blocked in every thread, and one thread waits for them. Until `open` a
    signal ends the process at once, with code 0; later it sets `asked`, and the owner ends. More
    signals change nothing. `BOUND` seconds after the first one the process ends in any case.

    Make it in the main thread, before there is any other thread.
    """

    def __init__(self) -> None:
        self._asked = threading.Event()
        self._lock = threading.Lock()
        self._opened = False
        self._wake: Callable[[], None] = lambda: None
        signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        threading.Thread(target=self._watch, name="signals", daemon=True).start()

    def asked(self) -> bool:
        """Whether a signal has come."""
        return self._asked.is_set()

    def open(self) -> None:
        """From now on the owner looks at `asked`, and ends."""
        with self._lock:
            self._opened = True

    def wake_with(self, wake: Callable[[], None]) -> None:
        """wake: what to call when a signal comes, in another thread; after `asked` is set."""
        with self._lock:
            self._wake = wake

    def leave(self, code: int) -> NoReturn:
        """End the process at once, whatever its threads do; the middleware cleans nothing up."""
        with contextlib.suppress(OSError, ValueError):  # nobody reads it any more
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)

    def _watch(self) -> None:
        signal.sigwait(SIGNALS)
        with self._lock:
            self._asked.set()
            if not self._opened:
                self.leave(0)
            with contextlib.suppress(Exception):  # what is to be woken has just been destroyed
                self._wake()
        if sys.__stderr__ is not None:
            # Should something keep Python itself from running: a thread that needs no Python.
            faulthandler.dump_traceback_later(2 * BOUND, exit=True, file=sys.__stderr__)
        threading.Event().wait(BOUND)
        print(f"stream_depth: not ended {BOUND} s after the signal, left", file=sys.stderr)
        self.leave(0)
