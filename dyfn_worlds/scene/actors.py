"""Things that move on their own: a mesh in a few poses, and where it is at a moment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Actor:
    """A mesh that stands on its origin with its front towards +x, in F poses.

    vertices: V of VERTEX_DTYPE (positions and normals are filled in by `posed`).
    positions, normals: F x V x 3, metres. triangles: T x 3.
    walk, idle: first pose and number of poses of each loop; a stiff thing has one pose.
    radius: of the footprint, metres. stride: metres of a walk loop.
    """

    name: str
    vertices: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    walk: tuple[int, int]
    idle: tuple[int, int]
    height: float
    radius: float
    stride: float = 1.4

    @property
    def stiff(self) -> bool:
        return len(self.positions) == 1

    def posed(self, place: Placement) -> np.ndarray:
        """The vertices at a place; between two poses of a loop they are interpolated."""
        first, count = self.walk if place.walking else self.idle
        at = place.phase % 1.0 * count
        a, b, share = first + int(at) % count, first + (int(at) + 1) % count, at - int(at)
        body = (1 - share) * self.positions[a] + share * self.positions[b]
        normals = (1 - share) * self.normals[a] + share * self.normals[b]
        cosine, sine = np.cos(place.yaw), np.sin(place.yaw)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float32)
        out: np.ndarray = self.vertices.copy()
        out["position"] = body @ turn.T + np.asarray(place.position, np.float32)
        out["normal"] = normals @ turn.T
        return out


@dataclass(frozen=True)
class Placement:
    """Where one actor is. phase: how far into its loop, in loops."""

    actor: int
    position: tuple[float, float, float]
    yaw: float
    walking: bool = False
    phase: float = 0.0


@dataclass(frozen=True)
class Moment:
    """What of a scene changes with time.

    placements: an actor appears at most once. lamps: gain of each of the scene's lights
    (empty: 1 each). ambient: gain of ambient and baked light.
    """

    placements: tuple[Placement, ...] = ()
    lamps: tuple[float, ...] = ()
    ambient: float = 1.0


STILL = Moment()
