"""Quake 3 player models (.md3): people-like figures with a walk and an idle loop.

A player is three models, chained by tags: `lower.md3` carries the torso, `upper.md3` the
head. Positions are 1/64 map units, z up, front towards +x.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from dyfn_worlds.maps.quake import GameFiles
from dyfn_worlds.scene.actors import Actor
from dyfn_worlds.scene.builder import SceneBuilder, new_vertices

HEADER = np.dtype(
    [("ident", "S4"), ("version", "<i4"), ("name", "S64"), ("flags", "<i4"), ("frames", "<i4"),
     ("tags", "<i4"), ("surfaces", "<i4"), ("skins", "<i4"), ("at_frames", "<i4"),
     ("at_tags", "<i4"), ("at_surfaces", "<i4"), ("at_end", "<i4")]
)  # fmt: skip
TAG = np.dtype([("name", "S64"), ("origin", "<f4", 3), ("axis", "<f4", (3, 3))])
SURFACE = np.dtype(
    [("ident", "S4"), ("name", "S64"), ("flags", "<i4"), ("frames", "<i4"), ("shaders", "<i4"),
     ("vertices", "<i4"), ("triangles", "<i4"), ("at_triangles", "<i4"), ("at_shaders", "<i4"),
     ("at_uv", "<i4"), ("at_vertices", "<i4"), ("at_end", "<i4")]
)  # fmt: skip
POINT = np.dtype([("position", "<i2", 3), ("normal", "u1", 2)])

# lines of animation.cfg, counted from 0
TORSO_GESTURE, TORSO_STANDS, LEGS_FIRST, LEGS_WALK, LEGS_IDLE = 6, (11, 12), 13, 14, 22
PARTS = ("lower", "upper", "head")


class ModelError(ValueError):
    """A file is no MD3 model, or a damaged one, or a player lacks a part."""


@dataclass(frozen=True)
class Surface:
    """positions, normals: frames x V x 3 in map units; uv: V x 2; triangles: T x 3."""

    name: str
    positions: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray


@dataclass(frozen=True)
class Model:
    """tags: name -> (origins frames x 3, axes frames x 3 x 3 whose rows are the basis)."""

    surfaces: list[Surface]
    tags: dict[str, tuple[np.ndarray, np.ndarray]]
    frames: int


def read_model(data: bytes, name: str) -> Model:
    """One .md3 file. Raises ModelError naming it when it is damaged."""
    try:
        header = np.frombuffer(data, HEADER, 1)[0]
        if header["ident"] != b"IDP3" or header["version"] != 15:
            raise ModelError(f"{name}: expected an IDP3 model of version 15, got {data[:8]!r}")
        count, n_tags = int(header["frames"]), int(header["tags"])
        tags = np.frombuffer(data, TAG, count * n_tags, header["at_tags"]).reshape(count, n_tags)
        surfaces, at = [], int(header["at_surfaces"])
        for _ in range(int(header["surfaces"])):
            surface, at = _surface(data, at)
            surfaces.append(surface)
    except (ValueError, IndexError) as error:
        raise error if isinstance(error, ModelError) else ModelError(f"{name}: {error}") from error
    named = {_text(t["name"][0]): (t["origin"], t["axis"]) for t in tags.T}
    return Model(surfaces, named, count)


def _surface(data: bytes, at: int) -> tuple[Surface, int]:
    head = np.frombuffer(data, SURFACE, 1, at)[0]
    frames, count = int(head["frames"]), int(head["vertices"])
    points = np.frombuffer(data, POINT, frames * count, at + int(head["at_vertices"]))
    points = points.reshape(frames, count)
    around, down = (points["normal"][..., i] * (2 * np.pi / 256) for i in (1, 0))
    normals = [np.cos(around) * np.sin(down), np.sin(around) * np.sin(down), np.cos(down)]
    triangles = np.frombuffer(data, "<i4", 3 * int(head["triangles"]),
                              at + int(head["at_triangles"]))  # fmt: skip
    uv = np.frombuffer(data, "<f4", 2 * count, at + int(head["at_uv"])).reshape(-1, 2)
    positions = points["position"].astype(np.float32) / 64
    surface = Surface(
        _text(head["name"]).lower(),
        positions,
        np.stack(normals, axis=-1).astype(np.float32),
        uv,
        triangles.reshape(-1, 3)[:, ::-1],  # clockwise in the file
    )
    return surface, at + int(head["at_end"])


def _text(raw: bytes) -> str:
    return bytes(raw).split(b"\0")[0].decode("latin-1")


def animations(text: str) -> list[tuple[int, int]]:
    """animation.cfg -> (first frame, count) of each line, leg frames as lower.md3 counts them."""
    lines = re.findall(r"^\s*(\d+)\s+(\d+)\s+\d+\s+\d+", text, re.MULTILINE)
    ranges = [(int(first), max(int(count), 1)) for first, count in lines]
    if len(ranges) <= LEGS_IDLE:
        raise ModelError(f"animation.cfg: expected over {LEGS_IDLE} animations, got {len(ranges)}")
    skipped = ranges[LEGS_FIRST][0] - ranges[TORSO_GESTURE][0]
    return [(f - skipped * (i >= LEGS_FIRST), n) for i, (f, n) in enumerate(ranges)]


def players(files: GameFiles) -> list[str]:
    """Folders of the players of which all three parts and the animation file are there."""
    wanted = [*(f"{part}.md3" for part in PARTS), "animation.cfg"]
    folders = {str(PurePosixPath(n).parent) for n in files.members if n.endswith("/lower.md3")}
    return sorted(f for f in folders if all(f"{f}/{w}" in files.members for w in wanted))


def skins(files: GameFiles, folder: str) -> list[str]:
    """Names of the skins that exist for all parts."""
    found = [
        {m.group(1) for n in files.members
         if (m := re.fullmatch(rf"{re.escape(folder)}/{part}_(\w+)\.skin", n))}
        for part in PARTS
    ]  # fmt: skip
    return sorted(set.intersection(*found))


def load_player(
    files: GameFiles, folder: str, skin: str, height: float, builder: SceneBuilder, stand: int = 0,
    recolor: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Actor:  # fmt: skip
    """One player, `height` metres tall, its textures in the builder's scene.

    stand: which of the two ways to hold the arms. recolor: applied to each image.
    Raises ModelError on damaged files.
    """
    models = {p: read_model(files.read(f"{folder}/{p}.md3"), f"{folder}/{p}.md3") for p in PARTS}
    ranges = animations(files.read(f"{folder}/animation.cfg").decode("latin-1"))
    legs = [np.arange(first, first + n) for first, n in (ranges[LEGS_WALK], ranges[LEGS_IDLE])]
    frames = np.clip(np.concatenate(legs), 0, models["lower"].frames - 1)
    torso = min(ranges[TORSO_STANDS[stand]][0], models["upper"].frames - 1)
    positions, normals, vertices, triangles, count = [], [], [], [], 0
    for part, (origin, axis) in _chain(models, frames, torso, folder).items():
        images = _skin(files, f"{folder}/{part}_{skin}.skin")
        which = {"lower": frames, "upper": np.array([torso]), "head": np.array([0])}[part]
        for surface in models[part].surfaces:
            image = files.image(images.get(surface.name, ""))
            if image is None:
                continue
            image = image if recolor is None else recolor(image)
            own = new_vertices(surface.positions.shape[1])
            own["uv"], own["texture"] = surface.uv, builder.texture(images[surface.name], image)
            positions.append(surface.positions[which] @ axis + origin[:, None])
            normals.append(surface.normals[which] @ axis)
            vertices.append(own)
            triangles.append(surface.triangles + count)
            count += len(own)
    if not vertices:
        raise ModelError(f"{folder}: no surface of skin {skin!r} has an image")
    return _actor(positions, normals, vertices, triangles, height, len(legs[0]), folder)


def _chain(
    models: dict[str, Model], frames: np.ndarray, torso: int, folder: str
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For each part its origin (F x 3) and axes (F x 3 x 3) in the figure, for each frame."""
    try:
        hip_origin, hip_axis = (x[frames] for x in models["lower"].tags["tag_torso"])
        neck_origin, neck_axis = (x[[torso]] for x in models["upper"].tags["tag_head"])
    except (KeyError, IndexError) as error:
        raise ModelError(f"{folder}: no tag or frame {error}") from error
    still = np.zeros((len(frames), 3), np.float32), np.tile(np.eye(3), (len(frames), 1, 1))
    head_origin = np.einsum("fj,fjk->fk", np.repeat(neck_origin, len(frames), 0), hip_axis)
    return {
        "lower": still,
        "upper": (hip_origin, hip_axis),
        "head": (head_origin + hip_origin, neck_axis @ hip_axis),
    }


def _skin(files: GameFiles, name: str) -> dict[str, str]:
    """Surface name -> image name."""
    pairs = [line.split(",", 1) for line in files.read(name).decode("latin-1").splitlines()]
    return {p[0].strip().lower(): p[1].strip().lower() for p in pairs if len(p) == 2 and p[1]}


def _actor(
    positions: list[np.ndarray], normals: list[np.ndarray], vertices: list[np.ndarray],
    triangles: list[np.ndarray], height: float, walking: int, name: str,
) -> Actor:  # fmt: skip
    count = max(len(p) for p in positions)
    body = np.concatenate([np.broadcast_to(p, (count, *p.shape[1:])) for p in positions], axis=1)
    turned = np.concatenate([np.broadcast_to(n, (count, *n.shape[1:])) for n in normals], axis=1)
    idle = body[walking:]
    scale = height / float(idle[..., 2].max() - idle[..., 2].min())
    body = (body - [0, 0, float(idle[..., 2].min())]) * scale
    return Actor(
        name=PurePosixPath(name).name,
        vertices=np.concatenate(vertices),
        positions=body.astype(np.float32),
        normals=turned.astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.int32),
        walk=(0, walking),
        idle=(walking, count - walking),
        height=height,
        radius=0.35,
    )
