"""Daylight baked into a scene's vertices: the sky through the windows, lamps, and two-way bounces.

The light that a vertex gets is the mean radiance over its cosine-weighted hemisphere, so that a
surface's radiance is its albedo times this light. Windows and lamps are sampled directly; what
comes from other surfaces is gathered over fixed rays, bounce by bounce.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.sparse import coo_matrix, csr_matrix, diags
from trimesh.ray.ray_pyembree import RayMeshIntersector

from dyfn_worlds.scene.scene import Scene, Window

OFF = 2e-3  # metres that rays start off their surface
CHUNK = 400_000  # rays at a time
OUTDOOR_EDGE = 2.0  # metres
FILL, GLARE = (
    0.6,
    1.5,
)  # light between leaves; how much brighter it is outdoors than the sky's light
SIDE_RAYS = 8
SMOOTHINGS = 4
LAMP_SIZE = 0.1  # metres around a lamp that cast no shadow
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class Lamp:
    """A small source: position in metres, color: radiance times area over pi, linear RGB."""

    position: np.ndarray
    color: np.ndarray


@dataclass(frozen=True)
class Sky:
    """Uniform above, with a brighter horizon; and the sun.

    sun_way: unit vector along which sunlight travels. sun: its light on a surface that faces it.
    """

    radiance: np.ndarray
    sun_way: np.ndarray
    sun: np.ndarray


@dataclass(frozen=True)
class Quality:
    """How fine. edge: longest triangle edge in metres; rays: of one hemisphere; pane: samples
    along each edge of a window; bounces: of light between surfaces."""

    edge: float = 0.18
    rays: int = 112
    pane: int = 5
    bounces: int = 5


def split_long_edges(vertices: np.ndarray, triangles: np.ndarray, edge: float) -> np.ndarray:
    """T x 3 vertices -> more triangles, none with an edge beyond `edge` metres.

    An edge is split by its length alone, so that neighbours split alike and no gap opens.
    """
    todo, done = vertices[triangles], []
    while len(todo):
        ends = todo["position"].astype(np.float64)
        length = np.linalg.norm(ends - np.roll(ends, -1, axis=1), axis=2)
        long = length > edge
        done.append(todo[~long.any(axis=1)])
        todo, length = todo[long.any(axis=1)], length[long.any(axis=1)]
        if not len(todo):
            break
        # turn each triangle so that its longest edge is the first, and split that one
        turn = (np.argmax(length, axis=1)[:, None] + np.arange(3)) % 3
        todo = np.take_along_axis(todo, turn, axis=1)
        middle = _between(todo[:, 0], todo[:, 1])
        todo = np.concatenate(
            [np.stack([todo[:, 0], middle, todo[:, 2]], axis=1),
             np.stack([middle, todo[:, 1], todo[:, 2]], axis=1)]
        )  # fmt: skip
    return np.concatenate(done)


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    middle = a.copy()
    for name in ("position", "normal", "uv", "color", "emission"):
        middle[name] = (a[name] + b[name]) / 2
    return middle


def welded(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T x 3 vertices -> vertices without doubles, and T x 3 indices."""
    flat = np.ascontiguousarray(corners.reshape(-1))
    for name in ("position", "normal", "uv", "color"):
        flat[name] = np.round(flat[name], 5) + 0.0  # no negative zeros
    raw = flat.view(np.dtype((np.void, flat.dtype.itemsize)))
    _, first, index = np.unique(raw, return_index=True, return_inverse=True)
    return flat[first], index.reshape(-1, 3).astype(np.int32)


class Rays:
    """First hits of rays with a mesh."""

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        self._corners = vertices["position"].astype(np.float64)[triangles]
        mesh = trimesh.Trimesh(vertices["position"], triangles, process=False)
        self._rays = RayMeshIntersector(mesh)

    def distance(self, origins: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """N x 3 origins and unit directions -> N metres, inf for none."""
        hit = self.first(origins, ways)
        seen = hit >= 0
        a, b, c = (self._corners[hit[seen], i] for i in range(3))
        normal = np.cross(b - a, c - a)
        out = np.full(len(origins), np.inf)
        slope = np.einsum("ij,ij->i", normal, ways[seen])
        with np.errstate(divide="ignore", invalid="ignore"):
            far = np.einsum("ij,ij->i", normal, a - origins[seen]) / slope
        out[seen] = np.nan_to_num(far, nan=0.0, posinf=0.0, neginf=0.0)
        return out

    def first(self, origins: np.ndarray, ways: np.ndarray) -> np.ndarray:
        """N x 3 origins and directions -> N triangles, -1 for none."""
        hits = [
            self._rays.intersects_first(origins[i : i + CHUNK], ways[i : i + CHUNK])
            for i in range(0, len(origins), CHUNK)
        ]
        return np.concatenate(hits) if hits else np.zeros(0, int)


def bake(
    scene: Scene, windows: Sequence[Window], lamps: Sequence[Lamp], sky: Sky,
    inside: tuple[np.ndarray, np.ndarray], quality: Quality, rng: np.random.Generator,
) -> Scene:  # fmt: skip
    """The scene in small triangles with its light in them: colours take its hue, emissions its
    luminance. The sun's own light on what is `inside` (a box: low, high) is left to the renderer.
    """
    corners = scene.vertices["position"][scene.triangles]
    indoors = ((corners > inside[0]) & (corners < inside[1])).all(axis=(1, 2))
    fine = split_long_edges(scene.vertices, scene.triangles[indoors], quality.edge)
    coarse = split_long_edges(scene.vertices, scene.triangles[~indoors], OUTDOOR_EDGE)
    vertices, triangles = welded(np.concatenate([fine, coarse]))
    indoor_triangle = np.arange(len(triangles)) < len(fine)
    rays = Rays(vertices, triangles)
    normals = _open_side(vertices, rays, rng)
    albedo = _albedo(scene, vertices, triangles)
    own = albedo * vertices["emission"][triangles].mean(axis=1)[:, None]
    origins = vertices["position"].astype(np.float64) + OFF * normals
    middles = vertices["position"][triangles].mean(axis=1).astype(np.float64)
    facing = normals[triangles].mean(axis=1)
    facing /= np.maximum(np.linalg.norm(facing, axis=1), 1e-9)[:, None]
    sunlit = _sun(rays, middles + OFF * facing, facing, sky)
    outdoor_vertex = np.ones(len(vertices), bool)
    outdoor_vertex[triangles[indoor_triangle]] = False

    hits = _hemisphere(rays, origins, normals, quality.rays, rng)
    direct = _lamps(rays, origins, normals, lamps)
    # outdoors the sky comes over the hemisphere, indoors through the sampled panes alone
    inner, outer = ~outdoor_vertex, outdoor_vertex
    direct[outer] += (hits[outer] < 0).mean(axis=1)[:, None] * sky.radiance
    direct[outer] += _sun(rays, origins[outer], normals[outer], sky)
    direct[outer] = GLARE * (direct[outer] + FILL * sky.radiance)
    outside = albedo * direct[triangles].mean(axis=1)
    outside = np.vstack([np.where(indoor_triangle[:, None], 0.0, outside), sky.radiance])
    direct[inner] += _panes(
        rays, origins[inner], normals[inner], windows, outside, quality.pane, rng
    )
    smooth = _smoother(vertices, triangles, normals)
    light = direct.copy()
    dark = np.zeros((1, 3))
    for _ in range(quality.bounces):
        sent = albedo * (light[triangles].mean(axis=1) + sunlit) + own
        bounced = _gathered(np.vstack([sent * indoor_triangle[:, None], dark]), hits)
        for _ in range(SMOOTHINGS):
            bounced = smooth @ bounced
        bounced[outer] = 0.0
        light = direct + bounced
    return _with_light(scene, vertices, triangles, normals, light)


def _gathered(table: np.ndarray, hits: np.ndarray) -> np.ndarray:
    """Mean over each row of hits of what its triangles send."""
    out = np.empty((len(hits), 3))
    for i in range(0, len(hits), 5000):
        out[i : i + 5000] = table[hits[i : i + 5000]].mean(axis=1)
    return out


def _with_light(
    scene: Scene, vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray,
    light: np.ndarray,
) -> Scene:  # fmt: skip
    luminance = light @ LUMINANCE
    vertices = vertices.copy()
    vertices["normal"] = normals
    vertices["color"] *= light / np.maximum(luminance, 1e-6)[:, None]
    vertices["emission"] += luminance
    return Scene(
        vertices, triangles, scene.textures,
        # a scene with baked light mirrors nothing
        lightmaps=[np.zeros((128, 128, 3), np.uint8)],
        lights=scene.lights, ambient=np.zeros(3, np.float32), sky=scene.sky, name=scene.name,
    )  # fmt: skip


def _albedo(scene: Scene, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """T x 3: the mean of each triangle's texture, linear, times its colour."""
    means = np.array([(t.reshape(-1, 3) / 255.0).mean(axis=0) ** 2 for t in scene.textures])
    first = vertices[triangles[:, 0]]
    return np.minimum(means[first["texture"]] * first["color"], 0.9)


def _open_side(vertices: np.ndarray, rays: Rays, rng: np.random.Generator) -> np.ndarray:
    """Unit normals, turned over where a model's own look into its inside."""
    normals = vertices["normal"].astype(np.float64)
    normals[np.linalg.norm(normals, axis=1) < 1e-6] = [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    room = []
    for side in (1, -1):
        total = np.zeros(len(normals))
        for _ in range(SIDE_RAYS):
            ways = side * normals + 0.7 * rng.normal(size=normals.shape)
            ways *= np.sign(side * np.einsum("ij,ij->i", ways, normals))[:, None]
            ways /= np.linalg.norm(ways, axis=1)[:, None]
            starts = vertices["position"] + OFF * side * normals
            total += np.minimum(rays.distance(starts, ways), 2.0) / SIDE_RAYS
        room.append(total)
    turned = (room[0] < 0.35) & (room[1] > 2 * room[0])
    return np.where(turned[:, None], -normals, normals)


def _basis(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    other = np.where(np.abs(normals[:, 2:]) > 0.9, [[1.0, 0, 0]], [[0, 0, 1.0]])
    u = np.cross(other, normals)
    u /= np.linalg.norm(u, axis=1)[:, None]
    return u, np.cross(normals, u)


def _hemisphere(
    rays: Rays, origins: np.ndarray, normals: np.ndarray, count: int, rng: np.random.Generator
) -> np.ndarray:
    """V x count triangles that cosine-weighted rays meet, -1 for none."""
    u, v = _basis(normals)
    out = np.empty((len(origins), count), np.int32)
    index = np.arange(count) + 0.5
    radius, turn = np.sqrt(index / count), np.pi * (1 + 5**0.5) * index
    for start in range(0, len(origins), 4000):
        part = slice(start, start + 4000)
        phase = rng.uniform(0, 2 * np.pi, (len(origins[part]), 1))
        x, y = radius * np.cos(turn + phase), radius * np.sin(turn + phase)
        z = np.sqrt(np.maximum(1 - radius**2, 1e-4))
        ways = x[..., None] * u[part, None] + y[..., None] * v[part, None]
        ways += z[None, :, None] * normals[part, None]
        starts = np.repeat(origins[part], count, axis=0)
        out[part] = rays.first(starts, ways.reshape(-1, 3)).reshape(-1, count)
    return out


def _panes(
    rays: Rays, origins: np.ndarray, normals: np.ndarray, windows: Sequence[Window],
    outside: np.ndarray, side: int, rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Light through each window, over a jittered grid of points on its pane.

    outside: (T + 1) x 3 radiance of each triangle, 0 indoors; the last is the sky's.
    """
    light = np.zeros((len(origins), 3))
    grid = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)) / side
    for window in windows:
        area = 4 * np.linalg.norm(window.right) * np.linalg.norm(window.up)
        before = (origins - window.centre) @ window.inward > 0
        for cell in grid:
            at = 2 * (cell + rng.random((len(origins), 2)) / side) - 1
            points = window.centre + at[:, :1] * window.right + at[:, 1:] * window.up
            way = points - origins
            far = np.linalg.norm(way, axis=1)
            way /= np.maximum(far, 1e-6)[:, None]
            cosine = np.einsum("ij,ij->i", way, normals)
            leaving = -(way @ window.inward)
            wanted = np.flatnonzero(before & (cosine > 0) & (leaving > 0))
            seen = outside[rays.first(origins[wanted], way[wanted])]
            weight = cosine[wanted] * leaving[wanted] * area / side**2
            weight /= np.pi * np.maximum(far[wanted], 0.15) ** 2
            light[wanted] += weight[:, None] * seen
    return light


def _sun(rays: Rays, origins: np.ndarray, normals: np.ndarray, sky: Sky) -> np.ndarray:
    cosine = np.maximum(-normals @ sky.sun_way, 0)
    light = np.zeros((len(origins), 3))
    wanted = np.flatnonzero(cosine > 0)
    ways = np.broadcast_to(-sky.sun_way, (len(wanted), 3))
    free = wanted[rays.first(origins[wanted], np.ascontiguousarray(ways)) < 0]
    light[free] = cosine[free, None] * sky.sun
    return light


def _lamps(
    rays: Rays, origins: np.ndarray, normals: np.ndarray, lamps: Sequence[Lamp]
) -> np.ndarray:
    light = np.zeros((len(origins), 3))
    for lamp in lamps:
        way = lamp.position - origins
        far = np.linalg.norm(way, axis=1)
        way /= np.maximum(far, 1e-6)[:, None]
        cosine = np.einsum("ij,ij->i", way, normals)
        wanted = np.flatnonzero(cosine > 0)
        free = wanted[rays.distance(origins[wanted], way[wanted]) > far[wanted] - LAMP_SIZE]
        light[free] += (cosine[free] / np.maximum(far[free], 0.2) ** 2)[:, None] * lamp.color
    return light


def _smoother(vertices: np.ndarray, triangles: np.ndarray, normals: np.ndarray) -> csr_matrix:
    """V x V: half of each vertex and half of the mean of its neighbours on the same surface."""
    key = np.concatenate([np.round(vertices["position"], 3), np.round(normals, 1)], axis=1)
    _, place = np.unique(key, axis=0, return_inverse=True)
    place = place.reshape(-1)
    count, points = len(vertices), int(place.max()) + 1
    onto = coo_matrix((np.ones(count), (place, np.arange(count))), shape=(points, count)).tocsr()
    onto = diags(1 / np.maximum(onto.sum(axis=1).A1, 1)) @ onto
    corners = place[triangles]
    a = np.concatenate([corners[:, i] for i in (0, 1, 2, 0, 1, 2)])
    b = np.concatenate([corners[:, i] for i in (1, 2, 0, 2, 0, 1)])
    near = coo_matrix((np.ones(len(a)), (a, b)), shape=(points, points)).tocsr()
    near.data[:] = 1
    near = diags(1 / np.maximum(near.sum(axis=1).A1, 1)) @ near
    mixed = (onto + near @ onto) * 0.5
    back = coo_matrix((np.ones(count), (np.arange(count), place)), shape=(count, points)).tocsr()
    return back @ mixed
