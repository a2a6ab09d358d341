"""The stage that gives no depth of pictures that are none of a scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.frozen_camera import FrozenCamera
from dyfn_core.stream.options import StreamOptions
from dyfn_core.stream.picture_check import BLANK, FROZEN, contrast
from dyfn_core.stream.stages import StreamStage


class PictureStage(StreamStage):
    """A covered lens, a flash, a frozen camera: nothing is valid, and nothing is measured by it.

    The stream goes on underneath: the first good picture has depth again.

    Attributes:
        unusable: How many pictures gave no depth, by reason.
    """

    def __init__(self, options: Callable[[], StreamOptions]) -> None:
        """options: Asked for at each frame."""
        self._options = options
        self._camera = FrozenCamera()
        self._fault = ""
        self.unusable: Counter[str] = Counter()

    def restore(self, state: None) -> None:
        """See StreamStage."""
        self._camera.reset()

    def started(self, reason: str | None) -> None:
        """See StreamStage."""
        self._camera.reset()

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        """See StreamStage."""
        self._fault = fault = self._judge(frame)
        if not fault:
            return prediction
        self.unusable[fault] += 1
        return replace(prediction, mask=np.zeros_like(prediction.mask))

    def _judge(self, frame: Frame) -> str:
        options = self._options()
        if options.frozen_after:
            self._camera.push(frame.image, frame.stamp, frame.pose)
            if self._camera.frozen(frame.stamp, frame.pose, options.frozen_after):
                return FROZEN
        else:
            self._camera.reset()
        if options.blank_contrast and contrast(frame.image) < options.blank_contrast:
            return BLANK
        return ""

    def report(self) -> dict[str, str]:
        """See StreamStage."""
        found = {f"pictures without depth, {why}": str(n) for why, n in self.unusable.items()}
        return {"picture": self._fault or "shows a scene", **found}

    def faults(self) -> list[str]:
        """See StreamStage."""
        return [self._fault] if self._fault else []
