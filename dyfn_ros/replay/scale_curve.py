"""The drift of the scale over time, as far as a video has come."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

COLOURS = ((31, 111, 214), (217, 102, 10))  # as the report's first two lines
GREY, BLACK = (200, 200, 200), (0, 0, 0)
MARGIN = (40, 24, 12, 36)  # pixels left, above, right and below
LINE = 14  # pixels from one name to the next
TITLE = "true over predicted depth, one alignment (flat: no drift)"


class ScaleCurve:
    """Draws lines that grow with the frames, on axes that stay.

    lines: name -> true over aligned depth of every frame, NaN for none; beside the name stands the
    drift so far, the standard deviation of its log. seconds: of every frame from the first; where
    they fall, frames are counted.
    """

    def __init__(self, lines: Mapping[str, np.ndarray], seconds: np.ndarray) -> None:
        self._lines = dict(lines)
        falling = (np.diff(seconds) < 0).any()
        self._x = np.arange(len(seconds), dtype=np.float64) if falling else seconds
        self._unit = "frame" if falling else "s"
        known = np.concatenate([values[np.isfinite(values)] for values in lines.values()])
        low, high = np.percentile(known, [1, 99]) if known.size else (1.0, 1.0)
        room = max(0.1 * (high - low), 0.05)
        self._span = min(low, 1.0) - room, max(high, 1.0) + room

    def draw(self, number: int, size: tuple[int, int]) -> np.ndarray:
        """The lines up to frame `number`, size[0] x size[1] x 3 uint8 RGB."""
        picture = np.full((*size, 3), 255, np.uint8)
        left, above, right, below = MARGIN
        x = left + self._x / max(self._x[-1], 1e-9) * (size[1] - left - right)
        low, high = self._span

        def rows(values: np.ndarray) -> np.ndarray:
            shares = (np.clip(values, low, high) - low) / (high - low)
            found: np.ndarray = size[0] - below - shares * (size[0] - above - below)
            return found

        _write(picture, TITLE, (4, 15))
        for value in (low, 1.0, high):
            y = round(float(rows(np.array(value))))
            cv2.line(picture, (left, y), (size[1] - right, y), GREY, 1)
            _write(picture, f"{value:.2f}", (4, y + 4))
        _write(picture, f"{self._x[number]:.1f} {self._unit}", (size[1] - 70, size[0] - 6))
        for place, (name, values) in enumerate(self._lines.items()):
            colour = COLOURS[place % len(COLOURS)]
            known = np.flatnonzero(np.isfinite(values[: number + 1]))
            so_far = f", drift {np.std(np.log(values[known])):.3f}" if known.size > 1 else ""
            _write(picture, name + so_far, (left, size[0] - 6 - LINE * place), colour)
            if known.size:
                points = np.stack([x[known], rows(values[known])], axis=1).round().astype(np.int32)
                runs = np.split(points, np.flatnonzero(np.diff(known) > 1) + 1)
                cv2.polylines(picture, runs, False, colour, 2, cv2.LINE_AA)
                cv2.circle(picture, (int(points[-1, 0]), int(points[-1, 1])), 4, colour, -1)
        return picture


def _write(
    picture: np.ndarray, text: str, corner: tuple[int, int], colour: tuple[int, int, int] = BLACK
) -> None:
    cv2.putText(picture, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
