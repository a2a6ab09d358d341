"""Quake 3 maps (IBSP version 46, in .pk3 zip files) as scenes: OpenArena's are free art.

32 map units are about one metre. Surfaces that a real camera would not see as solid
(nodraw, blended, alpha-tested, fog, sky) are left out; the sky becomes infinite depth.
"""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from dyfn_worlds.scene.builder import SceneBuilder, new_vertices
from dyfn_worlds.scene.scene import LIGHTMAP_SIZE, Scene

UNITS_PER_METRE = 32.0
PATCH_STEPS = 4
IMAGE_SUFFIXES = (".tga", ".jpg", ".png")
HIDDEN = {"nodraw", "sky", "trans", "fog", "water", "lava", "slime", "nomarks_hidden"}

VERTEX = np.dtype(
    [("position", "<f4", 3), ("uv", "<f4", 2), ("lm", "<f4", 2), ("normal", "<f4", 3),
     ("color", "u1", 4)]
)  # fmt: skip
FACE = np.dtype(
    [("texture", "<i4"), ("effect", "<i4"), ("type", "<i4"), ("vertex", "<i4"),
     ("n_vertices", "<i4"), ("meshvert", "<i4"), ("n_meshverts", "<i4"), ("lightmap", "<i4"),
     ("lm_start", "<i4", 2), ("lm_size", "<i4", 2), ("lm_origin", "<f4", 3),
     ("lm_vectors", "<f4", (2, 3)), ("normal", "<f4", 3), ("patch", "<i4", 2)]
)  # fmt: skip
TEXTURE = np.dtype([("name", "S64"), ("flags", "<i4"), ("contents", "<i4")])


class MapError(ValueError):
    """A file is no Quake 3 map, or a damaged one."""


@dataclass(frozen=True)
class Shader:
    """What a shader script says about one surface name.

    image: of the first stage that has one, often only a glow or an environment map.
    editor_image: what the map editor shows, the plain material.
    """

    image: str | None
    editor_image: str | None
    hidden: bool


@dataclass
class GameFiles:
    """The merged content of several .pk3 files; a later file replaces an earlier one's names.

    Raises FileNotFoundError when no .pk3 is among `paths`.
    """

    paths: list[Path]
    members: dict[str, tuple[zipfile.ZipFile, str]] = field(default_factory=dict)
    shaders: dict[str, Shader] = field(default_factory=dict)
    _images: dict[str, np.ndarray | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        archives = sorted({p.resolve() for p in self.paths if p.suffix == ".pk3"})
        if not archives:
            raise FileNotFoundError(f"no .pk3 file among {[str(p) for p in self.paths]}")
        for path in archives:
            archive = zipfile.ZipFile(path)
            for name in archive.namelist():
                self.members[name.lower()] = (archive, name)
        for name in sorted(self.members):
            if name.startswith("scripts/") and name.endswith(".shader"):
                self.shaders.update(parse_shaders(self.read(name).decode("latin-1")))

    def read(self, name: str) -> bytes:
        archive, member = self.members[name.lower()]
        return archive.read(member)

    def maps(self) -> list[str]:
        return sorted(n for n in self.members if n.startswith("maps/") and n.endswith(".bsp"))

    def image(self, name: str) -> np.ndarray | None:
        """The RGB image of a texture name, whatever its suffix on disk; None if there is none."""
        stem = re.sub(r"\.(tga|jpg|jpeg|png)$", "", name.lower())
        if stem not in self._images:
            found = next((stem + s for s in IMAGE_SUFFIXES if stem + s in self.members), None)
            self._images[stem] = None if found is None else decode_image(self.read(found))
        return self._images[stem]

    def surface(self, name: str) -> tuple[np.ndarray | None, bool]:
        """The image of a surface, and whether the surface is to be left out."""
        name = name.lower()
        if name.startswith("textures/common/"):
            return None, True
        shader = self.shaders.get(name)
        if shader is None:
            return self.image(name), False
        if shader.hidden:
            return None, True
        for candidate in (shader.editor_image, name, shader.image):
            if candidate and (image := self.image(candidate)) is not None:
                return image, False
        return None, False


def decode_image(data: bytes) -> np.ndarray | None:
    """PNG, JPEG or TGA bytes -> H x W x 3 uint8 RGB."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is not None:
        return np.ascontiguousarray(image[..., ::-1])
    return decode_tga(data)


def decode_tga(data: bytes) -> np.ndarray | None:
    """Targa types 2, 3, 10, 11 (raw and run-length), which OpenCV does not read."""
    if len(data) < 18 or data[2] not in (2, 3, 10, 11):
        return None
    width, height = int.from_bytes(data[12:14], "little"), int.from_bytes(data[14:16], "little")
    depth, top_down = data[16] // 8, bool(data[17] & 0x20)
    if depth not in (1, 3, 4) or not width or not height:
        return None
    body = memoryview(data)[18 + data[0] :]
    count = width * height * depth
    raw = bytes(body[:count]) if data[2] < 8 else _unpack_runs(body, count, depth)
    if len(raw) < count:
        return None
    pixels = np.frombuffer(raw, np.uint8)[:count].reshape(height, width, depth)
    pixels = np.repeat(pixels, 3, axis=2) if depth == 1 else pixels[..., 2::-1]
    return np.ascontiguousarray(pixels if top_down else pixels[::-1])


def _unpack_runs(body: memoryview, count: int, depth: int) -> bytes:
    out, at = bytearray(), 0
    while len(out) < count and at < len(body):
        length = (body[at] & 0x7F) + 1
        if body[at] & 0x80:
            out += bytes(body[at + 1 : at + 1 + depth]) * length
            at += 1 + depth
        else:
            out += bytes(body[at + 1 : at + 1 + depth * length])
            at += 1 + depth * length
    return bytes(out)


def parse_shaders(text: str) -> dict[str, Shader]:
    """Shader script -> {surface name: Shader}; only what decides visibility and image is read."""
    shaders: dict[str, Shader] = {}
    tokens = re.sub(r"//[^\n]*", "", text)
    name, depth = "", 0
    lines: list[tuple[int, str]] = []
    for line in tokens.replace("{", "\n{\n").replace("}", "\n}\n").splitlines():
        line = line.strip()
        if line == "{":
            depth += 1
        elif line == "}":
            depth -= 1
            if depth == 0 and name:
                shaders[name] = _shader(lines)
                name, lines = "", []
            continue
        elif line and depth == 0:
            name, lines = line.lower(), []
        if depth:
            lines.append((depth, line.lower()))
    return shaders


def _shader(lines: list[tuple[int, str]]) -> Shader:
    words = [(depth, line.split()) for depth, line in lines if line]
    parameters = {w[1] for depth, w in words if w[0] == "surfaceparm" and len(w) > 1}
    stages: list[list[list[str]]] = []
    for depth, word in words:
        if depth == 2 and word[0] == "{":
            stages.append([])
        elif depth == 2 and stages:
            stages[-1].append(word)
    image, blended = None, False
    for index, stage in enumerate(stages):
        keys = {w[0]: w[1:] for w in stage}
        source = keys.get("map") or keys.get("clampmap") or (keys.get("animmap") or ["", ""])[1:2]
        if index == 0 and ("blendfunc" in keys or "alphafunc" in keys):
            blended = "".join(keys.get("blendfunc", [])) != "gl_onegl_zero"
        if image is None and source and not source[0].startswith("$"):
            image = source[0]
    globals_ = {w[0]: w[1:] for depth, w in words if depth == 1}
    editor = next(iter(globals_.get("qer_editorimage", [])), None)
    hidden = bool(parameters & HIDDEN) or "skyparms" in globals_ or blended
    return Shader(image, editor, hidden)


def load_map(files: GameFiles, name: str, units_per_metre: float = UNITS_PER_METRE) -> Scene:
    """One map -> Scene, with the players' and items' places as viewpoints.

    Raises MapError when the file is no IBSP version 46 or has no surface.
    """
    data = files.read(name)
    if data[:4] != b"IBSP" or int.from_bytes(data[4:8], "little") != 46:
        raise MapError(f"{name}: expected an IBSP file of version 46, got {data[:8]!r}")
    directory = np.frombuffer(data, "<i4", 34, 8).reshape(17, 2)

    def lump(index: int, dtype: np.dtype | str) -> np.ndarray:
        kind = np.dtype(dtype)
        offset, length = directory[index]
        return np.frombuffer(data, kind, length // kind.itemsize, offset)

    builder = SceneBuilder()
    vertices, meshverts = lump(10, VERTEX), lump(11, "<i4")
    # names end at the first NUL; what follows it in the field is garbage
    surfaces = [bytes(t).split(b"\0")[0].decode("latin-1") for t in lump(1, TEXTURE)["name"]]
    for face in lump(13, FACE):
        image, hidden = files.surface(surfaces[face["texture"]])
        if hidden or image is None or face["type"] not in (1, 2, 3):
            continue
        mesh, triangles = _face_mesh(face, vertices, meshverts)
        if len(triangles):
            layer = builder.texture(surfaces[face["texture"]].lower(), image)
            builder.add(_to_scene(mesh, face, layer, units_per_metre), triangles)
    if not builder.textures:
        raise MapError(f"{name}: no visible surface")
    pages = lump(14, "u1").reshape(-1, LIGHTMAP_SIZE, LIGHTMAP_SIZE, 3)
    places = entity_places(bytes(lump(0, "u1")).decode("latin-1")) / units_per_metre
    stem = Path(name).stem
    return builder.build(lightmaps=list(pages), viewpoints=places, name=stem)


def _face_mesh(
    face: np.void, vertices: np.ndarray, meshverts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    own = vertices[face["vertex"] : face["vertex"] + face["n_vertices"]]
    if face["type"] == 2:
        return tessellate(own, tuple(face["patch"]))
    indices = meshverts[face["meshvert"] : face["meshvert"] + face["n_meshverts"]]
    return own, indices.reshape(-1, 3)


def tessellate(control: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """A grid of quadratic Bezier patches (size: columns, rows of control points) -> triangles."""
    columns, rows = int(size[0]), int(size[1])
    fields = ("position", "uv", "lm", "normal", "color")
    grid = np.concatenate([control[f].astype(np.float32) for f in fields], axis=1)
    grid = grid[: columns * rows].reshape(rows, columns, -1)
    grid = np.moveaxis(_subdivide(np.moveaxis(_subdivide(grid), 1, 0)), 1, 0)
    height, width = grid.shape[:2]
    flat, out = grid.reshape(height * width, -1), np.zeros(height * width, VERTEX)
    at = 0
    for name, count in zip(fields, (3, 2, 2, 3, 4), strict=True):
        out[name] = flat[:, at : at + count]
        at += count
    index = np.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return out, np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)


def _subdivide(grid: np.ndarray) -> np.ndarray:
    t = np.linspace(0, 1, PATCH_STEPS + 1, dtype=np.float32)[:, None, None]
    parts = []
    for start in range(0, grid.shape[0] - 2, 2):
        p0, p1, p2 = grid[start : start + 3]
        piece = (1 - t) ** 2 * p0 + 2 * t * (1 - t) * p1 + t**2 * p2
        parts.append(piece if start == 0 else piece[1:])
    return np.concatenate(parts)


def _to_scene(mesh: np.ndarray, face: np.void, layer: int, units_per_metre: float) -> np.ndarray:
    out = new_vertices(len(mesh))
    out["position"] = mesh["position"] / units_per_metre
    out["normal"] = mesh["normal"]
    out["uv"], out["lightmap_uv"] = mesh["uv"], mesh["lm"]
    out["texture"], out["lightmap"] = layer, max(int(face["lightmap"]), -1)
    if face["lightmap"] < 0:
        # vertex-lit models: bake the light into the colour and let it glow by it
        out["color"] = np.maximum(mesh["color"][:, :3] / 255.0, 0.05)
        out["emission"] = 0.8
    return out


def entity_places(text: str) -> np.ndarray:
    """Origins (N x 3, map units) of the entities that stand in free space."""
    wanted = ("info_player", "item_", "weapon_", "ammo_", "holdable_", "info_notnull", "team_ctf")
    places = []
    for block in re.findall(r"\{([^}]*)\}", text):
        pairs = dict(re.findall(r'"([^"]*)"\s+"([^"]*)"', block))
        if pairs.get("classname", "").lower().startswith(wanted) and "origin" in pairs:
            numbers = pairs["origin"].split()
            if len(numbers) == 3:
                places.append([float(x) for x in numbers])
    return np.array(places, np.float64).reshape(-1, 3)
