"""What makes the scores of a sequence implausible, said once for all of its frames."""

from __future__ import annotations

import math
import zlib
from array import array
from collections import Counter
from dataclasses import dataclass

import numpy as np

from dyfn_core.geometry.camera import doubted_intrinsics, off_centre
from dyfn_core.scoring.edge_agreement import EdgeAgreement

NEAREST, FARTHEST = 0.05, 200.0  # metres: a median of true depth outside is doubted
MIN_FRAMES = 3  # for what only several frames can show
EDGE_FRAMES = 5  # with edges, to say that truth and pictures do not belong together
EDGES_LOOKED_AT = 64  # frames of a sequence, evenly spread
MIN_AGREEMENT = 0.9  # see EdgeAgreement
VALUES = 4096  # of a frame's truth, for its median
SAMPLED = 4  # every so many rows and columns tell frames apart
LONE_SHARE, LONE_RATIO = 0.005, 2.0  # of the pixels, and over all other depths: see _doubted_top
REPEATED = 0.5  # of the frames: more that repeat the truth before them are doubted


@dataclass(frozen=True)
class Remedies:
    """What a command's user can do, as the end of a warning; "" where there is nothing.

    Attributes:
        unit: Against truth in another unit.
        stamps: Against stamps that do not rise.
        truth: Against truth of something else.
        camera: Against wrong intrinsics.
        far: Against values that are too far.
    """

    unit: str = ""
    stamps: str = ""
    truth: str = ""
    camera: str = ""
    far: str = ""


class Plausibility:
    """Takes the frames of one sequence; some ten bytes of each are kept."""

    def __init__(self, expected_frames: int, remedies: Remedies | None = None) -> None:
        """Begin.

        Args:
            expected_frames: How many there will be, for the choice of those that are compared
                edge by edge.
            remedies: Options of the command that is run.
        """
        self._remedies = remedies or Remedies()
        self._every = max(1, math.ceil(expected_frames / EDGES_LOOKED_AT))
        self._frames = 0
        self._edges = EdgeAgreement()
        self._medians = array("f")  # of the frames with truth
        self._tops: Counter[float] = Counter()  # largest depths of many pixels, far beyond others
        self._flat = 0  # of these, those with one depth all over
        self._first: tuple[int, int] | None = None  # marks of the first pair
        self._last: tuple[int, int] | None = None
        self._same_image = self._same_truth = 0  # pairs that repeat the first
        self._frozen = 0  # pairs with another picture and the truth before it
        self._last_stamp: float = -math.inf
        self._not_rising = 0
        self._camera = ""  # what is wrong with the first intrinsics that are doubted

    def push(
        self,
        image: np.ndarray,
        truth: np.ndarray | None,
        stamp: float | None = None,
        camera_matrix: np.ndarray | None = None,
    ) -> None:
        """One frame.

        Args:
            image: H x W x 3 uint8 RGB.
            truth: H' x W' metres of the same view, NaN invalid; None without.
            stamp: Time, in any unit; None when there is none.
            camera_matrix: 3 x 3 in pixels; None when unknown.
        """
        index, self._frames = self._frames, self._frames + 1
        if stamp is not None:
            self._not_rising += stamp <= self._last_stamp
            self._last_stamp = stamp
        if camera_matrix is not None and not self._camera:
            (fx, _, cx), (_, fy, cy) = camera_matrix[:2].tolist()
            size = (image.shape[0], image.shape[1])
            pixels = (fx, fy, cx, cy)
            self._camera = doubted_intrinsics(pixels, size) or off_centre(pixels, size)
        if truth is None:
            return
        depth = truth[np.isfinite(truth) & (truth > 0)]
        if depth.size == 0:
            return
        depth = depth[:: max(1, depth.size // VALUES)]
        self._medians.append(float(np.median(depth)))
        self._flat += bool(depth.max() - depth.min() <= 1e-6 * depth.max())
        self._take_top(depth)
        self._compare((_mark(image), _mark(truth)))
        if index % self._every == 0:
            self._edges.push(image, truth)

    def _take_top(self, depth: np.ndarray) -> None:
        top = depth.max()
        others = depth[depth < top]
        if others.size == 0 or depth.size - others.size < LONE_SHARE * depth.size:
            return
        if top > LONE_RATIO * others.max():
            self._tops[float(top)] += 1

    def _compare(self, pair: tuple[int, int]) -> None:
        if self._first is None or self._last is None:
            self._first = pair
        else:
            self._same_image += pair[0] == self._first[0]
            self._same_truth += pair[1] == self._first[1]
            self._frozen += pair[1] == self._last[1] and pair[0] != self._last[0]
        self._last = pair

    def warnings(self, scored: int | None, farthest: float = math.inf) -> list[str]:
        """One sentence for each thing that is doubted.

        Args:
            scored: How many of the frames were scored; None when none were to be.
            farthest: Metres up to which truth was scored.
        """
        found = [self._doubted_stamps(), self._camera and f"{self._camera}{self._remedies.camera}"]
        if scored is not None and self._frames and scored < self._frames / 2:
            found.append(
                f"{scored} of {self._frames} frames are scored, less than half: the others have "
                "no ground truth or no depth, or too little of them in common"
            )
        if self._medians:
            found += [self._doubted_unit(), self._doubted_top(farthest), self._doubted_pairs()]
        return [text for text in found if text]

    def _doubted_stamps(self) -> str:
        if not self._not_rising:
            return ""
        return (
            f"stamps do not rise: {self._not_rising} of {self._frames} frames are not later than "
            f"the one before{self._remedies.stamps}"
        )

    def _doubted_unit(self) -> str:
        median = float(np.median(self._medians))
        if NEAREST <= median <= FARTHEST:
            return ""
        guess = ": millimetres read as metres?" if median > FARTHEST else ""
        return (
            f"the median of the true depth is {median:.4g} m, expected {NEAREST:g} to "
            f"{FARTHEST:g} m{guess}{self._remedies.unit}"
        )

    def _doubted_top(self, farthest: float) -> str:
        """Of depth that is one value wherever nothing was measured."""
        for top, count in self._tops.most_common(1):
            if count >= MIN_FRAMES and top <= farthest:
                return (
                    f"the true depth is {top:g} m in many pixels of {count} frames and less than "
                    f"{top / LONE_RATIO:g} m in all others of them: a word for no depth?"
                    f"{self._remedies.far}"
                )
        return ""

    def _doubted_pairs(self) -> str:
        """The strongest of the reasons why truth and pictures do not belong together."""
        count = len(self._medians)
        if self._flat == count:
            return f"the ground truth is one depth all over, in each of {count} frames"
        more = count - 1
        if count >= MIN_FRAMES:
            if self._same_truth == more and self._same_image == more:
                return f"all {count} pairs of picture and ground truth are equal"
            if self._same_truth == more:
                return f"the ground truth is the same in all {count} frames, the pictures are not"
            if self._same_image == more:
                return f"the picture is the same in all {count} frames, the ground truth is not"
            if self._frozen > REPEATED * more:
                return (
                    f"the ground truth stands still: in {self._frozen} of {count} frames it is "
                    f"that of the frame before, the picture is not{self._remedies.truth}"
                )
        if self._edges.frames < EDGE_FRAMES:
            return ""
        agreement = self._edges.agreement()
        if agreement >= MIN_AGREEMENT:
            return ""
        return (
            "the ground truth does not correlate with any picture: its edges lie on those of the "
            f"pictures no better than when displaced (ratio {agreement:.2f}, expected "
            f"{MIN_AGREEMENT:g}); of another camera, view or time?{self._remedies.truth}"
        )


def _mark(values: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(values[::SAMPLED, ::SAMPLED]).tobytes())
