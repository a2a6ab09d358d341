"""Scene cuts start a camera's stream anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from dyfn_core.stream.session import StreamFrame, StreamHook

if TYPE_CHECKING:
    from dyfn_core.stream.scene_cut import CutState

SCENE_CUT = "scene cut"


class SceneCutHook(StreamHook):
    """threshold: asked for at each frame; 0 switches it off."""

    def __init__(self, threshold: Callable[[], float]) -> None:
        from dyfn_core.stream.scene_cut import SceneCutDetector

        self._threshold = threshold
        self._detector = SceneCutDetector()

    @property
    def state(self) -> CutState:
        """What the detector remembers."""
        return self._detector.state

    def restore(self, state: CutState | None) -> None:
        """Go on from a remembered state; None starts anew."""
        self._detector.reset()
        if state is not None:
            self._detector.state = state

    def before_frame(self, frame: StreamFrame) -> str | None:
        """See StreamHook."""
        threshold = self._threshold()
        if not threshold:
            self._detector.reset()
            return None
        self._detector.threshold = threshold
        return SCENE_CUT if self._detector.push(frame.image) else None

    def report(self) -> dict[str, str]:
        """See StreamHook."""
        if not self._threshold():
            return {"scene cut": "off"}
        return {"scene cut": f"difference {self._detector.difference:.3f} of {self._threshold()}"}
