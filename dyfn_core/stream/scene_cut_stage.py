"""The stage that resets a stream at scene cuts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dyfn_core.prediction import Frame, Prediction
from dyfn_core.stream.resets import SCENE_CUT
from dyfn_core.stream.scene_cut import CutState, SceneCutDetector
from dyfn_core.stream.stages import StreamStage

_APART = 0.09  # seconds between looks at pictures that are skipped; from 0.3 on, motion matters
Place = Callable[[Frame], Frame]


class SceneCutStage(StreamStage):
    """Compares consecutive images before the network sees them."""

    saved_as = "cut"

    def __init__(self, threshold: Callable[[], float], place: Place) -> None:
        """Start without a picture.

        Args:
            threshold: Asked for at each frame; 0 switches the stage off.
            place: Gives a frame its pose, where it has none and that is known.
        """
        self._threshold, self._place = threshold, place
        self._detector = SceneCutDetector()
        self._passed = False  # whether a picture that was skipped began another scene

    @property
    def state(self) -> CutState:
        """See StreamStage."""
        return self._detector.state

    def restore(self, state: CutState | None) -> None:
        """See StreamStage."""
        self._detector.reset()
        self._passed = False
        if state is not None:
            # The time between saving and loading is no time between two pictures.
            self._detector.state = replace(state, stamp=None, pose=None)

    def before_frame(self, frame: Frame) -> str | None:
        """See StreamStage."""
        passed, self._passed = self._passed, False
        cut = self._look(frame, lambda: self._place(frame).pose)
        return SCENE_CUT if cut or passed else None

    def skipped(self, frame: Frame) -> None:
        """See StreamStage. Of many pictures some are enough."""
        last = self._detector.state.stamp
        if last is None or frame.stamp is None or not 0 <= frame.stamp - last < _APART:
            self._passed |= self._look(frame, lambda: None)

    def _look(self, frame: Frame, pose: Callable[[], np.ndarray | None]) -> bool:
        threshold = self._threshold()
        if not threshold:
            self._detector.reset()
            return False
        self._detector.threshold = threshold
        return self._detector.push(frame.image, frame.stamp, pose)

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        """See StreamStage."""
        self._detector.locate(frame.stamp, frame.pose)
        return prediction

    def report(self) -> dict[str, str]:
        """See StreamStage."""
        if not self._threshold():
            return {SCENE_CUT: "off"}
        found = self._detector
        return {SCENE_CUT: f"difference {found.difference:.3f} of {found.allowed:.3f}"}
