"""Pictures of the frames that will turn out worst, kept in bounded memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyfn_core.evaluation.report.frame_grid import ShownFrames
from dyfn_core.evaluation.report.pictures import DepthSnapshot, snapshot
from dyfn_core.prediction import DEPTH, DISPARITY
from dyfn_core.scoring.frame_scores import FrameScore

STRETCHES = 24  # parts of a recording; at most one frame of each is among the worst
KEPT = 10  # stretches a reason
WIDTH = 200


@dataclass(frozen=True)
class _Candidate:
    badness: float
    snapshot: DepthSnapshot


class WorstFrames:
    """Keeps the frames that any alignment of the whole sequence may find worst.

    Which frames are worst under the video protocol is known only when its one alignment is: at
    the end. They are those whose own scale lies lowest or highest, or whose shape is worst, so
    the most extreme by each of the three are kept, at most one of a stretch of the recording.
    """

    def __init__(self, expected_frames: int, quantity: str = DEPTH) -> None:
        self.quantity = quantity
        self.stretch = max(1, -(-expected_frames // STRETCHES))
        self._kept: tuple[dict[int, _Candidate], ...] = ({}, {}, {})

    def add(
        self,
        index: int,
        image: np.ndarray,
        depth: np.ndarray,
        truth: np.ndarray | None,
        score: FrameScore,
    ) -> None:
        """One frame, as it goes to a FrameStrip, and its score by itself."""
        if truth is None or score.metrics is None:
            return
        ratio = self._log_ratio(depth, truth)
        reasons = (-ratio, ratio, score.metrics["abs_rel"])
        small: DepthSnapshot | None = None
        for badness, kept in zip(reasons, self._kept, strict=True):
            if self._enters(kept, index, badness):
                small = small or snapshot(index, image, depth, truth, WIDTH)
                kept[index // self.stretch] = _Candidate(badness, small)
                if len(kept) > KEPT:
                    del kept[min(kept, key=lambda place: kept[place].badness)]

    def _log_ratio(self, depth: np.ndarray, truth: np.ndarray) -> float:
        predicted = depth[np.isfinite(depth) & (depth > 0)]
        true = truth[np.isfinite(truth) & (truth > 0)]
        if not predicted.size or not true.size:
            return 0.0
        sign = -1 if self.quantity == DISPARITY else 1
        return float(np.log(np.median(true)) - sign * np.log(np.median(predicted)))

    def _enters(self, kept: dict[int, _Candidate], index: int, badness: float) -> bool:
        same = kept.get(index // self.stretch)
        if same is not None:
            return badness > same.badness
        return len(kept) < KEPT or badness > min(c.badness for c in kept.values())

    def choose(self, errors: np.ndarray, count: int = 6) -> list[int]:
        """The worst frame of each of the `count` worst stretches, worst first. errors: of every
        frame, NaN where there is none."""
        chosen: dict[int, int] = {}
        for index in np.argsort(-errors, kind="stable").tolist():  # NaN comes last
            if len(chosen) == count or np.isnan(errors[index]):
                break
            chosen.setdefault(index // self.stretch, index)
        return list(chosen.values())

    def nearest(self, index: int, errors: np.ndarray) -> DepthSnapshot | None:
        """The kept frame of the same stretch with the largest error; None when none was kept."""
        place = index // self.stretch
        found = [kept[place].snapshot for kept in self._kept if place in kept]
        return max(found, key=lambda s: np.nan_to_num(errors[s.index]), default=None)

    def shown(self, snapshots: Sequence[DepthSnapshot], scale: float, shift: float) -> ShownFrames:
        """Kept frames, aligned by one scale and shift."""
        return ShownFrames(snapshots, scale, shift, self.quantity)
