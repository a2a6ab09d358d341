"""Pictures of a benchmark's frames: strips and worst frames, few however many sequences it has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyfn_core.evaluation.benchmarks.registry import BenchmarkSequence
from dyfn_core.evaluation.report.pictures import DepthSnapshot, FrameStrip
from dyfn_core.evaluation.report.worst_frames import WIDTH, WorstFrames
from dyfn_core.scoring.frame_scores import FrameScore
from dyfn_core.scoring.protocols import SequenceScore

STRIPS = 12  # sequences that are shown, evenly spaced over the benchmark
ROWS = 3  # frames of each
WORST = 6  # frames of the whole run


@dataclass(frozen=True)
class WorstFrame:
    """One of the worst frames of a run, by AbsRel under the video protocol.

    frame: counted from 0 over the scored frames; number: the data set's own. shown: the frame in
    the picture (a neighbour where the worst itself was not kept), None without one. picture:
    H x W x 3 uint8 RGB, aligned as the video protocol aligns its sequence.
    """

    sequence: str
    frame: int
    number: int
    abs_rel: float
    shown: int | None
    picture: np.ndarray | None


class SequencePictures:
    """Small copies of some frames of one sequence, until its alignment is known.

    strip: whether it is one of the sequences that are shown. quantity: depth or disparity.
    """

    def __init__(self, sequence: BenchmarkSequence, quantity: str, strip: bool) -> None:
        self.sequence = sequence
        self.strip = FrameStrip(len(sequence), ROWS, WIDTH, quantity) if strip else None
        self.worst = WorstFrames(len(sequence), quantity)

    def add(
        self,
        index: int,
        image: np.ndarray,
        predicted: np.ndarray,
        truth: np.ndarray,
        score: FrameScore,
    ) -> None:
        """One frame; image: H x W x 3 uint8 RGB; predicted, truth: h x w, NaN where unknown."""
        if self.strip is not None:
            self.strip.add(index, image, predicted, truth)
        self.worst.add(index, image, predicted, truth, score)


class BenchmarkPictures:
    """What the report of a run shows of its frames, of the method's first variant.

    strips: picture by sequence, of at most STRIPS sequences. worst: at most WORST frames of the
    run, worst first. names: of all sequences, in order.
    """

    def __init__(self, names: Sequence[str], quantity: str) -> None:
        last = max(len(names) - 1, 0)
        places = np.linspace(0, last, min(len(names), STRIPS)).round().astype(int)
        self._shown = {names[place] for place in places}
        self._quantity = quantity
        self.strips: dict[str, np.ndarray] = {}
        self.worst: list[WorstFrame] = []

    def begin(self, sequence: BenchmarkSequence) -> SequencePictures:
        """For the frames of this sequence; finish takes it when they are all there."""
        return SequencePictures(sequence, self._quantity, sequence.name in self._shown)

    def finish(self, taken: SequencePictures, video: SequenceScore | None) -> None:
        """Draw what is kept of a sequence. video: its score, None when nothing could be scored."""
        scale, shift = (1.0, 0.0) if video is None else (video.scale, video.shift)
        if taken.strip is not None and taken.strip.snapshots:
            self.strips[taken.sequence.name] = taken.strip.draw(scale, shift)
        if video is None:
            return
        errors = video.frames.column("abs_rel")
        for frame in taken.worst.choose(errors, WORST):
            if len(self.worst) == WORST and errors[frame] <= self.worst[-1].abs_rel:
                break
            shown = taken.worst.nearest(frame, errors)
            self._keep(taken, frame, float(errors[frame]), shown, video)

    def _keep(
        self,
        taken: SequencePictures,
        frame: int,
        error: float,
        shown: DepthSnapshot | None,
        video: SequenceScore,
    ) -> None:
        picture = None if shown is None else taken.worst.draw([shown], video.scale, video.shift)
        sequence = taken.sequence
        place = None if shown is None else shown.index
        self.worst.append(
            WorstFrame(sequence.name, frame, sequence.numbers[frame], error, place, picture)
        )
        self.worst.sort(key=lambda kept: -kept.abs_rel)
        del self.worst[WORST:]
