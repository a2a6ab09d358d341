"""The drive: living room, kitchen, a look at the dresser, the hall, the study."""

from __future__ import annotations

from drive.robot import Drive, Leg, drive

START = (0.85, 2.45, -8.0)
LEGS = (
    Leg(pause=0.5),
    Leg(points=[(2.4, 2.5), (4.2, 2.98), (5.46, 3.1), (6.8, 3.12), (7.98, 3.2)]),
    Leg(pause=1.5),
    Leg(heading=92.0),
    Leg(
        points=[(8.05, 4.0), (8.05, 4.75), (7.7, 5.1), (6.0, 5.12), (3.3, 5.12), (2.75, 5.3),
                (2.64, 5.9), (2.6, 6.5), (2.45, 7.05)]
    ),
    Leg(heading=126.0),
    Leg(pause=0.8),
)  # fmt: skip

STRIPS = ((5.46, 3.1), (8.05, 4.36))  # of metal, in the two open doorways


def the_drive() -> Drive:
    """The base's way through the home."""
    return drive(START, LEGS)
