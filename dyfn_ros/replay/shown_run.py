"""A run as the outputs for people show it: its name, its alignment, its scale over time."""

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
        scales: Each frame's own scale over the median of all, NaN where there is none.
    """

    name: str
    alignment: Alignment
    scales: np.ndarray
