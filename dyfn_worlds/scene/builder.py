"""Meshes and textures collected into a scene."""

from __future__ import annotations

import cv2
import numpy as np

from dyfn_worlds.scene.actors import Actor
from dyfn_worlds.scene.scene import NO_LIGHTMAP, TEXTURE_SIZE, VERTEX_DTYPE, Scene


def fit_texture(image: np.ndarray) -> np.ndarray:
    """Any H x W x 3 uint8 image -> TEXTURE_SIZE square, area-averaged when it shrinks."""
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    if image.shape[:2] == size:
        return np.ascontiguousarray(image)
    shrinks = image.shape[0] >= TEXTURE_SIZE
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


class SceneBuilder:
    """Collects meshes and textures into one Scene."""

    def __init__(self) -> None:
        self._vertices: list[np.ndarray] = []
        self._triangles: list[np.ndarray] = []
        self._count = 0
        self._texture_index: dict[object, int] = {}
        self.textures: list[np.ndarray] = []

    def texture(self, key: object, image: np.ndarray) -> int:
        """The layer of `image`, uploaded once for each key."""
        if key not in self._texture_index:
            self._texture_index[key] = len(self.textures)
            self.textures.append(fit_texture(image))
        return self._texture_index[key]

    def add(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        """vertices: VERTEX_DTYPE; triangles: T x 3, counted from this mesh's first vertex."""
        self._vertices.append(vertices)
        self._triangles.append(np.asarray(triangles, np.int32) + self._count)
        self._count += len(vertices)

    def quad(
        self,
        corners: np.ndarray,
        texture: int,
        repeat: tuple[float, float] = (1.0, 1.0),
        color: np.ndarray | None = None,
        emission: float = 0.0,
    ) -> None:
        """corners: 4 x 3, counter-clockwise seen from the front; uv runs along its two edges."""
        corners = np.asarray(corners, np.float32)
        normal = np.cross(corners[1] - corners[0], corners[3] - corners[0])
        vertices = new_vertices(4)
        vertices["position"] = corners
        vertices["normal"] = normal / max(float(np.linalg.norm(normal)), 1e-9)
        vertices["uv"] = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32) * repeat
        vertices["color"] = 1.0 if color is None else color
        vertices["texture"] = texture
        vertices["emission"] = emission
        self.add(vertices, np.array([[0, 1, 2], [0, 2, 3]]))

    def box(
        self,
        low: np.ndarray,
        high: np.ndarray,
        texture: int,
        yaw: float = 0.0,
        color: np.ndarray | None = None,
        metres_per_repeat: float = 1.0,
    ) -> None:
        """An axis-aligned box from low to high (metres), then turned by yaw about its centre."""
        centre = (np.asarray(low) + high) / 2
        half = (np.asarray(high) - low) / 2
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
        for axis in range(3):
            for sign in (-1.0, 1.0):
                u, v = np.eye(3)[(axis + 1) % 3] * sign, np.eye(3)[(axis + 2) % 3]
                n = np.eye(3)[axis] * sign
                face = np.array([n - u - v, n + u - v, n + u + v, n - u + v]) * half
                size = 2 * half[[(axis + 1) % 3, (axis + 2) % 3]] / metres_per_repeat
                self.quad(centre + face @ turn.T, texture, (size[0], size[1]), color)

    def build(self, **fields: object) -> Scene:
        """The finished Scene; fields are passed on to it."""
        return Scene(
            vertices=np.concatenate(self._vertices),
            triangles=np.concatenate(self._triangles),
            textures=self.textures,
            **fields,  # type: ignore[arg-type]
        )


def new_vertices(count: int) -> np.ndarray:
    """Vertices with white colour, no lightmap and no emission."""
    vertices = np.zeros(count, VERTEX_DTYPE)
    vertices["color"] = 1.0
    vertices["lightmap"] = NO_LIGHTMAP
    return vertices


def stiff_actor(name: str, mesh: SceneBuilder, yaw: float = 0.0) -> Actor:
    """What was built in `mesh` (around its origin) as one stiff actor.

    Its texture layers are those of `mesh`: share the texture table with the scene's builder.
    """
    scene = mesh.build()
    points = scene.vertices["position"]
    return Actor(
        name=name,
        vertices=scene.vertices,
        positions=points[None].copy(),
        normals=scene.vertices["normal"][None].copy(),
        triangles=scene.triangles,
        walk=(0, 1),
        idle=(0, 1),
        height=float(points[:, 2].max()),
        radius=float(np.linalg.norm(points[:, :2], axis=1).max()),
    )
