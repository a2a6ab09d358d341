"""H.264 in MP4, a picture at a time; needs the extra `video`."""

from __future__ import annotations

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from dyfn_core.extras import missing
from dyfn_core.files import OutputError, finished_file

CODEC = "libx264"
BASE = Fraction(1, 90_000)  # seconds of a tick


def load_av() -> Any:
    """PyAV, which loads ffmpeg's libraries. Raises OutputError that says what to install."""
    try:
        import av
    except ImportError as error:
        raise OutputError(f"writing a video needs PyAV: {missing(error)}") from error
    return av


class Mp4File:
    """A video whose frames have the size of the first, made even as yuv420p asks for.

    It appears under its name only when it is complete, and not at all without a frame. Pictures of
    another size are brought to it with their shape kept, on black. Raises OutputError.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._av = path, load_av()
        self._stack = ExitStack()
        self._stream: Any = None
        self._container: Any = None
        self._last = -1

    def __enter__(self) -> Mp4File:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None or self._stream is None:
            self._stack.__exit__(kind, error, trace)
            return
        with self._stack:
            self._container.mux(self._stream.encode())

    def write(self, picture: np.ndarray, seconds: float) -> None:
        """One frame.

        Args:
            picture: H x W x 3 uint8 RGB.
            seconds: When it is shown, from the start; a tick after the last one at the earliest.
        """
        if self._stream is None:
            self._begin(picture)
        height, width = self._stream.height, self._stream.width
        image = self._av.VideoFrame.from_ndarray(fitted(picture, (height, width)))
        image.pts = self._last = max(round(seconds / BASE), self._last + 1)
        image.time_base = BASE
        self._container.mux(self._stream.encode(image))

    def _begin(self, picture: np.ndarray) -> None:
        partial = self._stack.enter_context(finished_file(self._path))
        opened = self._av.open(
            str(partial.absolute()), "w", "mp4", options={"movflags": "faststart"}
        )
        self._container = self._stack.enter_context(opened)
        stream = self._container.add_stream(CODEC, options={"crf": "20", "preset": "veryfast"})
        stream.height, stream.width = (side + side % 2 for side in picture.shape[:2])
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = stream.time_base = BASE
        stream.codec_context.thread_count = 1
        self._stream = stream


def fitted(picture: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The picture as large as goes into (H, W) with its shape kept, black around it."""
    height, width = picture.shape[:2]
    spare = size[0] - height, size[1] - width
    if not all(0 <= one <= 1 for one in spare):
        share = min(size[0] / height, size[1] / width)
        height, width = max(1, round(height * share)), max(1, round(width * share))
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
        spare = size[0] - height, size[1] - width
    before = [one // 2 for one in spare]
    edges = [(first, one - first) for first, one in zip(before, spare, strict=True)]
    return np.ascontiguousarray(np.pad(picture, [*edges, (0, 0)]))
