"""Furniture of Sweet Home 3D libraries (.sh3f): real-sized models of free art.

A library is a zip file: a properties catalogue (sizes in centimetres) and OBJ models with
their materials, y up.
"""

from __future__ import annotations

import io
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import trimesh
from trimesh.resolvers import ZipResolver

from dyfn_worlds.scene.builder import SceneBuilder, fit_texture, new_vertices

MAX_MODEL_BYTES = 400_000
SMALL = 0.45


@dataclass(frozen=True)
class Piece:
    """One catalogue entry. size: (width, depth, height) in metres; the back is towards +y."""

    name: str
    category: str
    origin: Path
    model: str
    size: tuple[float, float, float]
    elevation: float
    rotation: tuple[float, ...]
    is_opening: bool


@dataclass(frozen=True)
class Part:
    """One material of a model. positions and normals in metres in the piece's own axes."""

    positions: np.ndarray
    normals: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray
    color: np.ndarray
    image: np.ndarray | None


def read_library(path: Path) -> list[Piece]:
    """The pieces of one .sh3f file. Raises ValueError when it holds no catalogue."""
    with zipfile.ZipFile(path) as archive:
        names = {n: archive.getinfo(n).file_size for n in archive.namelist()}
        if "PluginFurnitureCatalog.properties" not in names:
            raise ValueError(f"{path}: no PluginFurnitureCatalog.properties in it")
        text = archive.read("PluginFurnitureCatalog.properties").decode("latin-1")
    entries: dict[str, dict[str, str]] = {}
    for key, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.MULTILINE):
        entries.setdefault(number, {})[key] = value.strip()
    pieces = [_piece(path, entry) for entry in entries.values() if "model" in entry]
    return [p for p in pieces if 0 < names.get(p.model, 0) < MAX_MODEL_BYTES]


def _piece(path: Path, entry: dict[str, str]) -> Piece:
    width, depth, height = (float(entry.get(k, "50")) / 100 for k in ("width", "depth", "height"))
    return Piece(
        name=entry.get("name", ""),
        category=entry.get("category", ""),
        origin=path,
        model=entry["model"].lstrip("/"),
        size=(width, depth, height),
        elevation=float(entry.get("elevation", "0")) / 100,
        rotation=tuple(float(x) for x in entry.get("modelRotation", "").split()),
        is_opening=entry.get("doorOrWindow", "false") == "true",
    )


class Showroom:
    """All pieces of several libraries; models are read when first used and kept."""

    def __init__(self, libraries: list[Path]) -> None:
        self.pieces = [p for path in sorted(libraries) for p in read_library(path)]
        self._parts: dict[tuple[Path, str], list[Part]] = {}

    def of(self, *categories: str) -> list[Piece]:
        return [p for p in self.pieces if p.category in categories and not p.is_opening]

    def openings(self) -> list[Piece]:
        return [p for p in self.pieces if p.is_opening]

    def parts(self, piece: Piece) -> list[Part]:
        """The model's parts, scaled to the catalogue's size; empty when it cannot be read."""
        key = (piece.origin, piece.model)
        if key not in self._parts:
            self._parts[key] = load_parts(piece)
        return self._parts[key]

    def place(
        self,
        builder: SceneBuilder,
        piece: Piece,
        position: np.ndarray,
        yaw: float,
        tint: np.ndarray,
        images: dict[int, np.ndarray] | None = None,
    ) -> bool:
        """Adds the piece with its floor centre at position; False when its model is empty.

        images: textures that replace the model's own, by part index.
        """
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], np.float32)
        parts = self.parts(piece)
        for index, part in enumerate(parts):
            image = (images or {}).get(index, part.image)
            key = (piece.model, index) if image is part.image else (id(image), "replaced")
            white = np.full((1, 1, 3), 255, np.uint8)
            layer = builder.texture("white" if image is None else key,
                                    white if image is None else image)  # fmt: skip
            vertices = new_vertices(len(part.positions))
            vertices["position"] = part.positions @ turn.T + position
            vertices["normal"] = part.normals @ turn.T
            vertices["uv"] = part.uv
            vertices["color"] = part.color * tint
            vertices["texture"] = layer
            builder.add(vertices, part.triangles)
        return bool(parts)


def load_parts(piece: Piece) -> list[Part]:
    """Reads one model; a part is left out when it is mostly transparent."""
    with zipfile.ZipFile(piece.origin) as archive:
        folder = str(PurePosixPath(piece.model).parent)
        resolver = ZipResolver({n: io.BytesIO(archive.read(n)) for n in archive.namelist()
                                if n.startswith(folder)}).namespaced(folder)  # fmt: skip
        data = archive.read(piece.model)
    try:
        loaded = trimesh.load_scene(
            io.BytesIO(data), "obj", resolver=resolver, process=False, maintain_order=True
        )
    except (ValueError, IndexError, KeyError, TypeError):
        return []
    meshes = [m for m in loaded.geometry.values() if isinstance(m, trimesh.Trimesh)]
    meshes = [m for m in meshes if len(m.faces) and _opacity(m) > 0.5]
    return _fit(meshes, piece) if meshes else []


def _opacity(mesh: trimesh.Trimesh) -> float:
    material = getattr(mesh.visual, "material", None)
    diffuse = getattr(material, "diffuse", None)
    return 1.0 if diffuse is None or len(diffuse) < 4 else float(diffuse[3]) / 255


def _fit(meshes: list[trimesh.Trimesh], piece: Piece) -> list[Part]:
    turn = np.eye(3) if len(piece.rotation) != 9 else np.array(piece.rotation).reshape(3, 3)
    # Sweet Home 3D is y up with the front towards +z; ours is z up with the front towards -y
    axes = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) @ turn
    points = [np.asarray(m.vertices) @ axes.T for m in meshes]
    low = np.min([p.min(axis=0) for p in points], axis=0)
    extent = np.maximum(np.max([p.max(axis=0) for p in points], axis=0) - low, 1e-6)
    scale = np.array(piece.size) / extent
    origin = low + extent * [0.5, 0.5, 0.0]
    return [_part(m, (p - origin) * scale, axes) for m, p in zip(meshes, points, strict=True)]


def _part(mesh: trimesh.Trimesh, positions: np.ndarray, axes: np.ndarray) -> Part:
    normals = np.nan_to_num(np.asarray(mesh.vertex_normals) @ axes.T)
    uv = getattr(mesh.visual, "uv", None)
    if uv is None:
        uv = positions[:, :2] + positions[:, 2:] * [0.6, 1.0]
    else:
        uv = np.asarray(uv)[:, :2] * [1, -1]
    material = getattr(mesh.visual, "material", None)
    image = getattr(material, "image", None)
    diffuse = getattr(material, "diffuse", None)
    color = np.full(3, 0.6) if diffuse is None else np.asarray(diffuse[:3], float) / 255
    if image is not None:
        color = np.ones(3)
        image = fit_texture(np.asarray(image.convert("RGB")))
    return Part(
        positions.astype(np.float32),
        normals.astype(np.float32),
        uv.astype(np.float32),
        np.asarray(mesh.faces, np.int32),
        np.maximum(color, 0.04).astype(np.float32) ** 2,
        image,
    )
