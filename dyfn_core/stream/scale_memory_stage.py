"""The stage that steadies the scale of the depth by what the pictures show again."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from dyfn_core.metric.scale_memory import (
    ScaleMemoryFound,
    ScaleMemoryOptions,
    ScaleMemoryState,
    step,
)
from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.stages import StreamStage


class ScaleMemoryStage(StreamStage):
    """Depth and points times one factor a frame, see dyfn_core.metric.scale_memory.

    Works without odometry, on top of DyFN or without it. The stream's first frame is not changed.
    """

    saved_as = "scale_memory"

    def __init__(self) -> None:
        """Start without a picture."""
        self._how = ScaleMemoryOptions()
        self._state = ScaleMemoryState()
        self._found = ScaleMemoryFound()

    @property
    def state(self) -> ScaleMemoryState:
        """See StreamStage."""
        return self._state

    def restore(self, state: ScaleMemoryState | None) -> None:
        """See StreamStage."""
        self._state, self._found = state or ScaleMemoryState(), ScaleMemoryFound()

    def started(self, reason: str | None) -> None:
        """See StreamStage."""
        self.restore(None)

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        """See StreamStage."""
        self._state, self._found = step(
            self._state,
            frame.image,
            prediction.depth,
            prediction.valid,
            prediction.camera_matrix,
            self._how,
        )
        if not self._found.correction:
            return prediction
        factor = np.float32(math.exp(self._found.correction))
        return replace(
            prediction, depth=prediction.depth * factor, points=prediction.points * factor
        )

    def report(self) -> dict[str, str]:
        """See StreamStage."""
        found = self._found
        if not found.references:
            return {"scale memory": "nothing seen again"}
        return {
            "scale memory": f"factor {math.exp(found.correction):.3f} by {found.points} points, "
            f"{found.references} earlier pictures"
        }
