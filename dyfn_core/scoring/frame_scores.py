"""The scores of a sequence's frames, kept in columns: some hundred bytes a frame."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np

from dyfn_core.scoring.metrics import METRICS, mean_metrics


@dataclass(frozen=True)
class FrameScore:
    """One frame under the image protocol.

    coverage: share of the pixels with truth where the prediction is valid.
    pixels: scored samples. scale, shift: this frame's own alignment; with metrics None when
        fewer than MIN_PIXELS samples could be scored.
    """

    coverage: float
    pixels: int
    scale: float | None = None
    shift: float | None = None
    metrics: dict[str, float] | None = None


class MetricRows(Sequence["dict[str, float] | None"]):
    """METRICS of every frame, None for one that was not scored."""

    def __init__(self) -> None:
        self._values = array("d")

    def append(self, metrics: Mapping[str, float] | None) -> None:
        """The next frame."""
        values = [math.nan] * len(METRICS) if metrics is None else [metrics[m] for m in METRICS]
        self._values.extend(values)

    def __len__(self) -> int:
        return len(self._values) // len(METRICS)

    @overload
    def __getitem__(self, index: int) -> dict[str, float] | None: ...
    @overload
    def __getitem__(self, index: slice) -> list[dict[str, float] | None]: ...
    def __getitem__(
        self, index: int | slice
    ) -> dict[str, float] | list[dict[str, float] | None] | None:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        start = range(len(self))[index] * len(METRICS)
        values = self._values[start : start + len(METRICS)]
        return None if math.isnan(values[0]) else dict(zip(METRICS, values, strict=True))

    def column(self, name: str) -> np.ndarray:
        """One of METRICS of every frame, NaN where it was not scored."""
        table = np.array(self._values).reshape(-1, len(METRICS))
        return np.ascontiguousarray(table[:, METRICS.index(name)])

    def means(self) -> dict[str, float] | None:
        """Means over the scored frames; None without one."""
        scored = [metrics for metrics in self if metrics is not None]
        return mean_metrics(scored) if scored else None


class FrameScores(Sequence[FrameScore]):
    """FrameScores in the order of the frames; metrics: theirs, as MetricRows."""

    def __init__(self) -> None:
        self.metrics = MetricRows()
        self._columns = {name: array("d") for name in ("coverage", "pixels", "scale", "shift")}

    def append(self, score: FrameScore) -> None:
        """The next frame."""
        self.metrics.append(score.metrics)
        for name, values in self._columns.items():
            value = getattr(score, name)
            values.append(math.nan if value is None else value)

    def __len__(self) -> int:
        return len(self.metrics)

    @overload
    def __getitem__(self, index: int) -> FrameScore: ...
    @overload
    def __getitem__(self, index: slice) -> list[FrameScore]: ...
    def __getitem__(self, index: int | slice) -> FrameScore | list[FrameScore]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        coverage, pixels, scale, shift = (values[index] for values in self._columns.values())
        metrics = self.metrics[index]
        if metrics is None:
            return FrameScore(coverage, int(pixels))
        return FrameScore(coverage, int(pixels), scale, shift, metrics)

    def column(self, name: str) -> np.ndarray:
        """coverage, pixels, scale or shift of every frame; NaN for no alignment."""
        return np.array(self._columns[name])
