"""The MP4 of a replay: input, truth, base and result, in colours that stay the same; the scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.evaluation.report.frame_grid import depth_bar, draw_bars, error_bar
from dyfn_core.evaluation.report.pictures import colour_depth, colour_error, depth_range
from dyfn_core.files import OutputError, finished_file
from dyfn_ros.replay.frame_spool import FrameSpool, SmallFrame
from dyfn_ros.replay.scale_curve import ScaleCurve
from dyfn_ros.replay.shown_run import ShownRun

CODEC = "libx264"
TICKS = 1000  # of a second; the time base
BAR = 24  # pixels for the captions
RANGE_FRAMES = 32  # frames that the range of colours is of
USUAL_STEP, LONGEST_STEP = 0.1, 1.0  # seconds a frame is shown when stamps go back, and at most


def write_video(path: Path, spool: FrameSpool, runs: Sequence[ShownRun]) -> None:
    """H.264 of all frames at the pace of their stamps.

    One alignment for each run and one range of colours for all frames, so that drift and flicker
    are seen; truth, errors and scale are there when any frame has truth. Raises OutputError.

    Args:
        path: The file; it appears only when it is complete.
        spool: The frames.
        runs: The run, and the base model's where the spool has it.
    """
    try:
        import av  # loads ffmpeg's libraries: not for --help
    except ImportError as error:
        raise OutputError(
            f"--write video needs PyAV ({error}): install this package with its `video` extra"
        ) from error

    panels = _Panels(spool, runs)
    with (
        finished_file(path) as partial,
        av.open(str(partial), "w", "mp4", options={"movflags": "faststart"}) as container,
    ):
        stream = None
        for number, (time, frame) in enumerate(_timed(spool)):
            picture = panels.draw(number, frame)
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


class _Panels:
    """Draws frames with the range of colours that a first pass over them found."""

    def __init__(self, spool: FrameSpool, runs: Sequence[ShownRun]) -> None:
        self._runs = list(runs[: 2 if spool.has_base else 1])
        self._factors = [1.0] * len(self._runs)
        every = max(1, spool.frames // RANGE_FRAMES)
        truths: list[np.ndarray] = []
        depths: list[list[np.ndarray]] = [[] for _ in self._runs]
        stamps = []
        for index, frame in enumerate(spool):
            stamps.append(frame.stamp_ns)
            if index % every == 0:
                for found, depth in zip(depths, self._depths(frame), strict=True):
                    found.append(depth)
                truths += [] if frame.truth is None else [frame.truth]
        unit = "depth, m"
        if not all(run.alignment.metres for run in self._runs):
            self._factors = [1 / _median(found) for found in depths]
            depths = [
                [d * f for d in found] for found, f in zip(depths, self._factors, strict=True)
            ]
            unit = "depth over its median (up to scale)"
        self._truth = bool(truths)
        self._near, self._far = depth_range(truths or [d for found in depths for d in found])
        self._bars = [depth_bar(self._near, self._far, unit)]
        self._curve: ScaleCurve | None = None
        if self._truth:
            self._bars.append(error_bar())
            lines = {run.name: run.scales for run in self._runs}
            self._curve = ScaleCurve(lines, (np.array(stamps) - stamps[0]) / 1e9)

    def _depths(self, frame: SmallFrame) -> list[np.ndarray]:
        """Aligned depth of each run, NaN where there is none."""
        found = [frame.predicted, *([] if frame.base is None else [frame.base[0]])]
        nothing = np.full(frame.predicted.shape, np.nan, np.float32)
        found += [nothing] * (len(self._runs) - len(found))
        return [
            run.alignment.depth(predicted) * factor
            for run, predicted, factor in zip(self._runs, found, self._factors, strict=True)
        ]

    def draw(self, number: int, frame: SmallFrame) -> np.ndarray:
        """Rows and columns x 3 uint8 RGB, both even as yuv420p asks for.

        Above: input, truth, base, result; below, with truth: the scale so far, and the errors.
        """
        depths = dict(zip([run.name for run in self._runs], self._depths(frame), strict=True))
        ordered = dict(reversed(depths.items()))  # the base, then the result
        above = {"input": frame.image}
        below: list[np.ndarray] = []
        if self._curve is not None:
            truth = np.full(frame.image.shape[:2], np.nan) if frame.truth is None else frame.truth
            above["ground truth"] = self._paint(truth)
            height, width = frame.image.shape[:2]
            below.append(self._curve.draw(number, (height + BAR, 2 * width)))
            for name, depth in ordered.items():
                below.append(_captioned(f"error, {name}", colour_error(depth, truth)))
        above |= {name: self._paint(depth) for name, depth in ordered.items()}
        rows = [np.hstack([_captioned(name, panel) for name, panel in above.items()])]
        rows += [np.hstack(below)] if below else []
        drawn = np.vstack([*rows, draw_bars(self._bars, rows[0].shape[1])])
        odd = drawn.shape[0] % 2, drawn.shape[1] % 2
        return np.pad(drawn, ((0, odd[0]), (0, odd[1]), (0, 0)))

    def _paint(self, depth: np.ndarray) -> np.ndarray:
        return colour_depth(depth, self._near, self._far)


def _median(depths: Sequence[np.ndarray]) -> float:
    values = np.concatenate([d[np.isfinite(d) & (d > 0)] for d in depths])
    return float(np.median(values)) if values.size else 1.0


def _captioned(name: str, panel: np.ndarray) -> np.ndarray:
    bar = np.full((BAR, panel.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, name, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([bar, panel])
