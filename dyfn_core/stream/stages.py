"""What a stage of a stream session is: something that watches a stream or changes its output."""

from __future__ import annotations

from typing import Any

import numpy as np

from dyfn_core.prediction import Frame, Prediction


class StreamStage:
    """One stage of a StreamSession; the base does nothing.

    A session asks its stages in their order, for each frame: `before_frame`; `started`, when the
    stream begins with this frame; the network; `after_prediction`. These run in the thread that
    pushes the frames. A stage may use what came before the frame and the frame itself, nothing
    later.

    Attributes:
        saved_as: Field of SavedStream that holds `state` in a state file; "" for a stage that
            remembers nothing.
    """

    saved_as = ""

    @property
    def state(self) -> Any:
        """All that the stage remembers between two frames; a value that is never changed."""
        return None

    def restore(self, state: Any) -> None:
        """Go on from a remembered state; None is that of a new stream."""

    def before_frame(self, frame: Frame) -> str | None:
        """A reason to reset the stream before this frame, or None."""
        return None

    def skipped(self, frame: Frame) -> None:
        """A frame between the last one and the coming one that is not worked on."""

    def started(self, reason: str | None) -> None:
        """The stream begins with the coming frame: reset for a reason, or None for the first."""

    def after_prediction(
        self, frame: Frame, prediction: Prediction[np.ndarray]
    ) -> Prediction[np.ndarray]:
        """What goes on to the next stage, and from the last one to the caller."""
        return prediction

    def report(self) -> dict[str, str]:
        """For diagnostics, any thread: name and value."""
        return {}

    def problems(self) -> list[str]:
        """For diagnostics, any thread: what a user should look at."""
        return []

    def faults(self) -> list[str]:
        """For diagnostics, any thread: why the last frame has no depth at all."""
        return []
