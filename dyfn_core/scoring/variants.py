"""Several predictions of one sequence scored side by side, with the controls on the same pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from dyfn_core.prediction import DEPTH
from dyfn_core.scoring.protocols import CONTROLS, SequenceScorer, predicted, to_shape


@dataclass(frozen=True)
class VariantScore:
    """AbsRel and delta1 under the image and video protocols (paper section 5)."""

    image_abs_rel: float
    image_delta1: float
    video_abs_rel: float
    video_delta1: float

    @classmethod
    def of(cls, scorer: SequenceScorer) -> VariantScore | None:
        """The scores of the frames pushed so far; None when no frame could be scored."""
        image, video = scorer.image(), scorer.video()
        if image is None or video is None:
            return None
        return cls(
            image.metrics["abs_rel"],
            image.metrics["delta1"],
            video.metrics["abs_rel"],
            video.metrics["delta1"],
        )


def mean_scores(scores: Iterable[VariantScore | None]) -> VariantScore:
    """Means over the sequences that could be scored; NaN without any."""
    known = [score for score in scores if score is not None]
    names = [field.name for field in fields(VariantScore)]
    if not known:
        return VariantScore(*[np.nan] * len(names))
    return VariantScore(*(float(np.mean([getattr(s, name) for s in known])) for name in names))


class VariantScorers:
    """The scorers of a sequence: one per variant, and one per control.

    Args:
        variants: names of the predictions; pictures are of the first.
        quantity: of all of them; see SequenceScorer.
        scorer: gives an empty scorer of a quantity.
        control_scorer: the same for the controls, which may do with fewer samples; None: scorer.
        controls: the name that each of CONTROLS has beside the variants. They are scored where
            the first variant predicts something.

    Attributes:
        scorers: by name, the variants before the controls.
    """

    def __init__(
        self,
        variants: Sequence[str],
        quantity: str = DEPTH,
        scorer: Callable[[str], SequenceScorer] = lambda quantity: SequenceScorer(
            quantity=quantity
        ),
        controls: Mapping[str, str] | None = None,
        control_scorer: Callable[[str], SequenceScorer] | None = None,
    ) -> None:
        self.variants = tuple(variants)
        self.quantity = quantity
        self._controls = dict(controls or {})
        self.scorers = {name: scorer(quantity) for name in self.variants}
        empty = control_scorer or scorer
        self.scorers |= {name: empty(DEPTH) for name in self._controls.values()}

    @property
    def first(self) -> SequenceScorer:
        """Of the first variant."""
        return self.scorers[self.variants[0]]

    def push(self, found: Mapping[str, np.ndarray], truth: np.ndarray) -> dict[str, np.ndarray]:
        """Score one frame.

        Args:
            found: prediction H x W of each variant, up to scale and shift.
            truth: h x w metres, of the same field of view.

        Returns:
            Everything that was scored by name, h x w; a control is NaN where it was not.

        Raises:
            ValueError: a prediction has another aspect ratio than the truth.
        """
        maps = {name: to_shape(found[name], truth.shape) for name in self.variants}
        if self._controls:
            valid = predicted(maps[self.variants[0]], self.quantity)
            for control, name in self._controls.items():
                values = CONTROLS[control]((truth.shape[0], truth.shape[1]))
                maps[name] = np.where(valid, values, np.float32(np.nan))
        for name, values in maps.items():
            self.scorers[name].push(values, truth)
        return maps

    def scores(self) -> dict[str, VariantScore | None]:
        """The score of each; None for one without a frame that could be scored."""
        return {name: VariantScore.of(scorer) for name, scorer in self.scorers.items()}
