"""What poses of an odometry are believed; options are made of it, so nothing slow is in here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PoseLimits:
    """What poses are believed.

    Attributes:
        tolerance: Seconds beyond either end of the poses in which the motion is taken to go on.
        gap: Seconds between two poses beyond which nothing is known of the time between them.
        speed: Metres a second; a faster step between two poses is a jump.
        turn: Radians a second, likewise.
        back: Seconds that a stamp may come late; farther back, time has gone back.
        capacity: Poses that are kept, the latest; None: all.
    """

    tolerance: float = 0.05
    gap: float = 0.5
    speed: float = 10.0
    turn: float = 10.0
    back: float = 0.2
    capacity: int | None = 20_000
