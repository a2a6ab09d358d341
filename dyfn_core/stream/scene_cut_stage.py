"""The stage that resets a stream at scene cuts."""

from __future__ import annotations

from collections.abc import Callable

from dyfn_core.prediction import Frame
from dyfn_core.stream.resets import SCENE_CUT
from dyfn_core.stream.scene_cut import CutState, SceneCutDetector
from dyfn_core.stream.stages import StreamStage


class SceneCutStage(StreamStage):
    """Compares consecutive images before the network sees them."""

    saved_as = "cut"

    def __init__(self, threshold: Callable[[], float]) -> None:
        """threshold: Asked for at each frame; 0 switches the stage off."""
        self._threshold = threshold
        self._detector = SceneCutDetector()

    @property
    def state(self) -> CutState:
        """See StreamStage."""
        return self._detector.state

    def restore(self, state: CutState | None) -> None:
        """See StreamStage."""
        self._detector.reset()
        if state is not None:
            self._detector.state = state

    def before_frame(self, frame: Frame) -> str | None:
        """See StreamStage."""
        threshold = self._threshold()
        if not threshold:
            self._detector.reset()
            return None
        self._detector.threshold = threshold
        return SCENE_CUT if self._detector.push(frame.image) else None

    def report(self) -> dict[str, str]:
        """See StreamStage."""
        if not self._threshold():
            return {"scene cut": "off"}
        return {"scene cut": f"difference {self._detector.difference:.3f} of {self._threshold()}"}
