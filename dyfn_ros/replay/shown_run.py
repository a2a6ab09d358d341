"""A run as the outputs for people show it: its name, its alignment, its drift over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyfn_core.scoring.protocols import align_depth


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


@dataclass(frozen=True)
class ShownRun:
    """One run over the frames of a FrameSpool.

    Attributes:
        name: What it is called.
        alignment: Of its predictions.
        ratios: True over aligned depth of each frame, as SequenceScore.ratios; NaN without truth.
    """

    name: str
    alignment: Alignment
    ratios: np.ndarray
