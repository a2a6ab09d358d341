"""Pictures of a benchmark's frames: strips and worst frames, few however many sequences it has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dyfn_core.evaluation.benchmarks.registry import BenchmarkSequence
from dyfn_core.evaluation.report.frame_grid import FrameGrid, FrameStrip, frame_grid
from dyfn_core.evaluation.report.pictures import DepthSnapshot
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
    a row, aligned as the video protocol aligns its sequence.
    """

    sequence: str
    frame: int
    number: int
    abs_rel: float
    shown: int | None
    picture: FrameGrid | None


def _frame_label(index: int) -> str:
    return f"frame {index}"


class SequencePictures:
    """Small copies of some frames of one sequence, until its alignment is known.

    strips: names of the variants that are shown; the worst frames are of the first of `variants`.
    quantity: depth or disparity.
    """

    def __init__(
        self,
        sequence: BenchmarkSequence,
        quantity: str,
        variants: Sequence[str],
        strips: Sequence[str],
    ) -> None:
        self.sequence = sequence
        self.first = variants[0]
        self.strips = {name: FrameStrip(len(sequence), ROWS, WIDTH, quantity) for name in strips}
        self.worst = WorstFrames(len(sequence), quantity)

    def add(
        self,
        index: int,
        image: np.ndarray,
        predicted: Mapping[str, np.ndarray],
        truth: np.ndarray,
        score: FrameScore,
    ) -> None:
        """One frame; image: H x W x 3 uint8 RGB; predicted (by variant), truth: h x w, NaN where
        unknown; score: of the first variant."""
        for name, strip in self.strips.items():
            strip.add(index, image, predicted[name], truth)
        self.worst.add(index, image, predicted[self.first], truth, score)


class BenchmarkPictures:
    """What the report of a run shows of its frames.

    strips: the variants' frames by sequence, of at most STRIPS sequences. worst: at most WORST
    frames of the run, of the first variant, worst first. names: of all sequences, in order.
    variants: of the method; shown: those in the strips.
    """

    def __init__(
        self, names: Sequence[str], quantity: str, variants: Sequence[str], shown: Sequence[str]
    ) -> None:
        last = max(len(names) - 1, 0)
        places = np.linspace(0, last, min(len(names), STRIPS)).round().astype(int)
        self._shown = {names[place] for place in places}
        self._quantity = quantity
        self._variants, self._in_strips = variants, shown
        self.strips: dict[str, FrameGrid] = {}
        self.worst: list[WorstFrame] = []

    def begin(self, sequence: BenchmarkSequence) -> SequencePictures:
        """For the frames of this sequence; finish takes it when they are all there."""
        strips = self._in_strips if sequence.name in self._shown else ()
        return SequencePictures(sequence, self._quantity, self._variants, strips)

    def finish(self, taken: SequencePictures, videos: Mapping[str, SequenceScore | None]) -> None:
        """Draw what is kept of a sequence. videos: score by variant, None when nothing could be
        scored."""
        strips = {}
        for name, strip in taken.strips.items():
            score = videos[name]
            aligned = (1.0, 0.0) if score is None else (score.scale, score.shift)
            strips[name] = strip.shown(*aligned)
        if any(frames.snapshots for frames in strips.values()):
            name = taken.sequence.name
            self.strips[name] = frame_grid(strips, _frame_label, f"some frames of {name}")
        video = videos[taken.first]
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
        sequence, picture = taken.sequence, None
        if shown is not None:
            frames = {taken.first: taken.worst.shown([shown], video.scale, video.shift)}
            name = sequence.name
            picture = frame_grid(frames, lambda index: f"{name}, frame {index}", "worst frame")
        place = None if shown is None else shown.index
        self.worst.append(
            WorstFrame(sequence.name, frame, sequence.numbers[frame], error, place, picture)
        )
        self.worst.sort(key=lambda kept: -kept.abs_rel)
        del self.worst[WORST:]
