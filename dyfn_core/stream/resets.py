"""Why a stream is reset: one list of reasons, and the rules that find the first of them."""

from __future__ import annotations

from dataclasses import dataclass

REQUESTED = "requested"  # by the program that owns the stream
RESET_SERVICE = "reset service"  # of the node
TIME_JUMP = "ROS time jumped"
BACKWARDS = "stamp went back"
GAP = "gap between stamps"
NEW_SIZE = "image size changed"
NEW_FRAME_ID = "frame_id changed"
NEW_CAMERA = "intrinsics changed"
NEW_SETTINGS = "settings changed"
FAILED = "inference failed"
SCENE_CUT = "scene cut"

# After these, stamps of before and after are not comparable.
ANOTHER_CLOCK = (BACKWARDS, TIME_JUMP)


@dataclass(frozen=True)
class TimeRules:
    """When stamps say that a frame cannot follow the one before.

    Attributes:
        tolerance: Seconds that a stamp may go back.
        max_gap: Seconds that may pass between two frames; 0 is no limit.
    """

    tolerance: float = 0.2
    max_gap: float = 5.0

    def broken(self, before: float | None, now: float | None) -> str | None:
        """The reason to reset, or None.

        Args:
            before: Stamp of the last frame in seconds; None when unknown.
            now: Stamp of the coming frame.

        Example:
            >>> TimeRules().broken(10.0, 10.1)
            >>> TimeRules().broken(10.0, 16.0)
            'gap between stamps'
            >>> TimeRules().broken(10.0, 9.0)
            'stamp went back'
        """
        if before is None or now is None:
            return None
        if now < before - self.tolerance:
            return BACKWARDS
        return GAP if self.max_gap and now > before + self.max_gap else None
