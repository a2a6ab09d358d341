"""The MP4 of a replay: input, truth, base and result, in colours that stay the same; the drift."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from dyfn_core.evaluation.report.colours import colour_depth, colour_error, depth_range
from dyfn_core.evaluation.report.frame_grid import depth_bar, draw_bars, error_bar
from dyfn_ros.replay.frame_spool import FrameSpool, SmallFrame
from dyfn_ros.replay.mp4 import Mp4File, load_av
from dyfn_ros.replay.scale_curve import ScaleCurve
from dyfn_ros.replay.shown_run import ShownRun

BAR = 24  # pixels for the captions
RANGE_FRAMES = 32  # frames that the range of colours is of
USUAL_STEP, LONGEST_STEP = 0.1, 1.0  # seconds a frame is shown when stamps go back, and at most


def write_video(path: Path, spool: FrameSpool, runs: Sequence[ShownRun]) -> None:
    """H.264 of all frames at the pace of their stamps.

    One alignment for each run and one range of colours for all frames, so that drift and flicker
    are seen; truth, errors and drift are there when any frame has truth. Raises OutputError.

    Args:
        path: The file; it appears only when it is complete.
        spool: The frames.
        runs: The run, and the base model's where the spool has it.
    """
    load_av()
    panels = _Panels(spool, runs)
    with Mp4File(path) as video:
        for number, (time, frame) in enumerate(_timed(spool)):
            video.write(panels.draw(number, frame), time)


def _timed(spool: FrameSpool) -> Iterator[tuple[float, SmallFrame]]:
    """Frames with when they are shown: 0, then as far apart as their stamps, within limits."""
    time, last = 0.0, None
    for frame in spool:
        if last is not None:
            step = (frame.stamp_ns - last) / 1e9
            time += min(step, LONGEST_STEP) if step > 0 else USUAL_STEP
        last = frame.stamp_ns
        yield time, frame


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
            lines = {run.name: run.ratios for run in self._runs}
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
        """Rows x columns x 3 uint8 RGB.

        Above: input, truth, base, result; below, with truth: the drift so far, and the errors.
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
        return np.vstack([*rows, draw_bars(self._bars, rows[0].shape[1])])

    def _paint(self, depth: np.ndarray) -> np.ndarray:
        return colour_depth(depth, self._near, self._far)


def _median(depths: Sequence[np.ndarray]) -> float:
    values = np.concatenate([d[np.isfinite(d) & (d > 0)] for d in depths])
    return float(np.median(values)) if values.size else 1.0


def _captioned(name: str, panel: np.ndarray) -> np.ndarray:
    bar = np.full((BAR, panel.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, name, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([bar, panel])
