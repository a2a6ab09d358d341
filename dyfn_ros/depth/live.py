"""Frames of cameras and network streams: the newest one, however slow its user is."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import cv2
import numpy as np

from dyfn_ros.recordings.errors import RecordingError

PATIENCE = 10.0  # seconds without a frame after which a source is gone
LOOK = 0.1  # seconds between looks at whether the user wants to stop


class Capture(Protocol):
    """What is used of cv2.VideoCapture."""

    def isOpened(self) -> bool: ...  # noqa: N802
    def read(self) -> tuple[bool, Any]: ...
    def get(self, property: int, /) -> float: ...
    def set(self, property: int, value: float, /) -> bool: ...
    def release(self) -> None: ...


Open = Callable[[str], Capture]


def open_capture(source: str) -> Capture:
    """OpenCV's capture of a camera's number or device, or of an address."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # errors are told by us
    if source.isdecimal() or source.startswith("/dev/"):
        return cv2.VideoCapture(int(source) if source.isdecimal() else source)
    wait = round(PATIENCE * 1000)
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, wait, cv2.CAP_PROP_READ_TIMEOUT_MSEC, wait]
    return cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)


class LiveCapture:
    """The newest frames of a source; a thread reads it, so that frames do not queue up.

    Attributes:
        dropped: Frames that came while an earlier one was worked on.
        ended: Why there are no more frames; "" while there are.
    """

    def __init__(
        self,
        name: str,
        capture: Capture,
        expected: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to read.

        Args:
            name: Of the source, for messages.
            capture: Opened.
            expected: What the message says was expected when it is not open.
            clock: Seconds.

        Raises:
            RecordingError: It is not open, or gives no frame.
        """
        self.dropped, self.ended = 0, ""
        self._name, self._capture, self._clock = name, capture, clock
        self._newest: tuple[np.ndarray, float] | None = None
        self._read, self._closing = 0, False
        self._changed = threading.Condition()
        if not capture.isOpened():
            raise RecordingError(f"{name}: cannot be opened; expected {expected}")
        self._thread = threading.Thread(target=self._follow, name="capture", daemon=True)
        self._thread.start()

    def _follow(self) -> None:
        try:
            while not self._closing:
                done, pixels = self._capture.read()
                if not done:
                    break
                frame = np.ascontiguousarray(pixels[..., ::-1]), self._clock()
                with self._changed:
                    self.dropped += self._newest is not None
                    self._newest = frame
                    self._read += 1
                    self._changed.notify()
        finally:
            with self._changed:
                self.ended = self.ended or f"{self._name}: gave no more frames after {self._read}"
                self._changed.notify()
            self._capture.release()

    def frames(self, stopped: Callable[[], bool]) -> Iterator[tuple[np.ndarray, float]]:
        """Image (H x W x 3 uint8 RGB) and seconds since the first, until the source ends.

        Args:
            stopped: Whether the user wants no more.
        """
        first: float | None = None
        while not stopped():
            with self._changed:
                waited = self._clock()
                while self._newest is None and not self.ended and not stopped():
                    self._changed.wait(LOOK)
                    if self._clock() - waited > PATIENCE:
                        self.ended = f"{self._name}: no frame for {PATIENCE:g} s"
                frame, self._newest = self._newest, None
            if frame is None:
                return
            first = frame[1] if first is None else first
            yield frame[0], frame[1] - first

    def close(self) -> None:
        """End the thread, unless the source holds it."""
        self._closing = True
        self._thread.join(1.0)
