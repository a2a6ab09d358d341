"""The MP4 of a replay: input, depth and error side by side, in colours that stay the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.evaluation.report.pictures import MAX_ERROR, colour_depth, colour_error, depth_range
from dyfn_core.files import OutputError, finished_file
from dyfn_core.scoring.protocols import align_depth
from dyfn_ros.replay.frame_spool import FrameSpool, SmallFrame

CODEC = "libx264"
TICKS = 1000  # of a second; the time base
BAR = 24  # pixels for the captions
RANGE_FRAMES = 32  # frames that the range of colours is of
USUAL_STEP, LONGEST_STEP = 0.1, 1.0  # seconds a frame is shown when stamps go back, and at most


@dataclass(frozen=True)
class Alignment:
    """How predictions become one depth for the whole recording.

    Attributes:
        scale, shift: Of the video protocol; 1 and 0 without truth.
        quantity: What is aligned.
        metres: Whether the aligned depth is in metres; else it is right up to scale.
    """

    scale: float = 1.0
    shift: float = 0.0
    quantity: str = "depth"
    metres: bool = False

    def depth(self, predicted: np.ndarray) -> np.ndarray:
        """H x W depth or disparity, as predicted -> aligned depth."""
        return align_depth(predicted, self.scale, self.shift, self.quantity)


def write_video(path: Path, spool: FrameSpool, alignment: Alignment) -> None:
    """H.264 of all frames at the pace of their stamps.

    One alignment and one range of colours for all frames, so that drift and flicker are seen;
    the error panel is there when any frame has truth. Raises OutputError.
    """
    try:
        import av  # loads ffmpeg's libraries: not for --help
    except ImportError as error:
        raise OutputError(
            f"--write video needs PyAV ({error}): install this package with its `video` extra"
        ) from error

    colours = _Colours(spool, alignment)
    with (
        finished_file(path) as partial,
        av.open(str(partial), "w", "mp4", options={"movflags": "faststart"}) as container,
    ):
        stream = None
        for time, frame in _timed(spool):
            picture = colours.draw(frame)
            if stream is None:
                stream = container.add_stream(CODEC, options={"crf": "20", "preset": "veryfast"})
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
                stream.codec_context.time_base = stream.time_base = Fraction(1, TICKS)
                stream.codec_context.thread_count = 1
            image = av.VideoFrame.from_ndarray(_fit(picture, stream.height, stream.width))
            image.pts, image.time_base = round(time * TICKS), Fraction(1, TICKS)
            container.mux(stream.encode(image))
        if stream is not None:
            container.mux(stream.encode())


def _timed(spool: FrameSpool) -> Iterator[tuple[float, SmallFrame]]:
    """Frames with when they are shown: 0, then as far apart as their stamps, within limits."""
    time, last = 0.0, None
    for frame in spool:
        if last is not None:
            step = (frame.stamp_ns - last) / 1e9
            # Two frames may not share a tick.
            time += min(max(step, 2 / TICKS), LONGEST_STEP) if step > 0 else USUAL_STEP
        last = frame.stamp_ns
        yield time, frame


def _fit(picture: np.ndarray, height: int, width: int) -> np.ndarray:
    """A frame of another size than the first is scaled to it."""
    if picture.shape[:2] != (height, width):
        picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(picture)


class _Colours:
    """Draws frames with the range of colours that a first pass over them found."""

    def __init__(self, spool: FrameSpool, alignment: Alignment) -> None:
        self._alignment = alignment
        every = max(1, spool.frames // RANGE_FRAMES)
        truths, depths = [], []
        for index, frame in enumerate(spool):
            if index % every == 0:
                depths.append(alignment.depth(frame.predicted))
                truths += [] if frame.truth is None else [frame.truth]
        self._error = bool(truths)
        self._near, self._far = depth_range(truths or depths)

    def draw(self, frame: SmallFrame) -> np.ndarray:
        """Rows and columns x 3 uint8 RGB, both even as yuv420p asks for."""
        depth = self._alignment.depth(frame.predicted)
        panels = {"input": frame.image}
        unit = "m" if self._alignment.metres else "(up to scale)"
        panels[f"depth {self._near:.2g} to {self._far:.2g} {unit}"] = colour_depth(
            depth, self._near, self._far
        )
        if self._error:
            truth = np.full(depth.shape, np.nan) if frame.truth is None else frame.truth
            panels[f"error 0 to {MAX_ERROR:.0%}"] = colour_error(depth, truth)
        drawn = np.hstack([_captioned(name, panel) for name, panel in panels.items()])
        rows, columns = drawn.shape[0] % 2, drawn.shape[1] % 2
        return np.pad(drawn, ((0, rows), (0, columns), (0, 0)))


def _captioned(name: str, panel: np.ndarray) -> np.ndarray:
    bar = np.full((BAR, panel.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, name, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([bar, panel])
