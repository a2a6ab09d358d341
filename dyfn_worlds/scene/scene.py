"""A textured triangle scene in metres: what worlds build and the renderer draws."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dyfn_worlds.scene.actors import Actor

TEXTURE_SIZE = 256
LIGHTMAP_SIZE = 128
NO_LIGHTMAP = -1

VERTEX_DTYPE = np.dtype(
    [
        ("position", "f4", 3),
        ("normal", "f4", 3),
        ("uv", "f4", 2),
        ("color", "f4", 3),
        ("lightmap_uv", "f4", 2),
        ("texture", "i4"),
        ("lightmap", "i4"),
        ("emission", "f4"),
    ]
)


@dataclass(frozen=True)
class Window:
    """A rectangle in a wall: centre +- right +- up, in metres. bars: of its frame, each way."""

    centre: np.ndarray
    right: np.ndarray
    up: np.ndarray
    bars: int = 1

    @property
    def inward(self) -> np.ndarray:
        """Unit normal, into the room."""
        normal = np.cross(self.up, self.right)
        result: np.ndarray = normal / np.linalg.norm(normal)
        return result

    def corners(self) -> np.ndarray:
        """4 x 3."""
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        result: np.ndarray = self.centre + signs[:, :1] * self.right + signs[:, 1:] * self.up
        return result


@dataclass(frozen=True)
class Light:
    """A spot light that casts shadows. position in metres, color linear RGB radiance at 1 m.

    window: the light shines through it alone, and what stands before it casts no shadow.
    """

    position: np.ndarray
    direction: np.ndarray
    color: np.ndarray
    cone_degrees: float = 120.0
    window: Window | None = None


@dataclass
class Scene:
    """Triangles, their textures and their light. World axes: x, y horizontal, z up; metres.

    vertices: structured array of VERTEX_DTYPE.
    triangles: T x 3 int32 indices.
    textures: list of TEXTURE_SIZE x TEXTURE_SIZE x 3 uint8 RGB.
    lightmaps: list of LIGHTMAP_SIZE x LIGHTMAP_SIZE x 3 uint8 RGB (baked light).
    viewpoints: N x 3 positions known to be in free space, from which paths start.
    actors: what may be placed in it at a moment; their textures are among `textures`.
    interests: N x 3 points that people look at (table tops, shelves); may be empty.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    textures: list[np.ndarray]
    lightmaps: list[np.ndarray] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    ambient: np.ndarray = field(default_factory=lambda: np.full(3, 0.3, np.float32))
    sky: np.ndarray = field(default_factory=lambda: np.full((2, 3), 0.8, np.float32))
    viewpoints: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    actors: list[Actor] = field(default_factory=list)
    interests: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    name: str = "scene"
