"""Quake 3 maps: a map written here byte by byte comes back as the surfaces it holds."""

import io
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.pack_art import RecordedFiles, pack_maps
from dyfn_worlds.maps import quake


def png(color: tuple[int, int, int]) -> bytes:
    image = np.full((16, 16, 3), color, np.uint8)
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def bsp(names: list[str], faces: list[dict], vertices: np.ndarray, meshverts: list[int]) -> bytes:
    textures = np.zeros(len(names), quake.TEXTURE)
    textures["name"] = [n.encode() for n in names]
    records = np.zeros(len(faces), quake.FACE)
    for record, face in zip(records, faces, strict=True):
        record["lightmap"] = -1
        for key, value in face.items():
            record[key] = value
    entities = b'{ "classname" "info_player_deathmatch" "origin" "32 64 96" }\0'
    lumps = [b""] * 17
    lumps[0], lumps[1] = entities, textures.tobytes()
    lumps[10], lumps[11] = vertices.tobytes(), np.array(meshverts, "<i4").tobytes()
    lumps[13] = records.tobytes()
    directory, at = [], 8 + 17 * 8
    for lump in lumps:
        directory.append((at, len(lump)))
        at += len(lump)
    return (
        b"IBSP"
        + (46).to_bytes(4, "little")
        + np.array(directory, "<i4").tobytes()
        + b"".join(lumps)
    )


@pytest.fixture
def game(tmp_path: Path) -> quake.GameFiles:
    vertices = np.zeros(4 + 9, quake.VERTEX)
    vertices["color"] = 255
    vertices["position"][:4] = [[0, 0, 0], [32, 0, 0], [32, 32, 0], [0, 32, 0]]
    grid = [[x, y, 32.0 * (x == 16)] for y in (0, 16, 32) for x in (0, 16, 32)]
    vertices["position"][4:] = grid
    flat = {"type": 1, "vertex": 0, "n_vertices": 4, "meshvert": 0, "n_meshverts": 6}
    curved = {"type": 2, "vertex": 4, "n_vertices": 9, "patch": (3, 3)}
    faces = [flat, {**flat, "texture": 1}, {**curved, "texture": 2}]
    names = ["textures/a/red", "textures/a/glass", "textures/a/green"]
    script = "textures/a/glass\n{\n  {\n  map textures/a/red.tga\n  blendFunc add\n  }\n}\n"
    with zipfile.ZipFile(tmp_path / "pak.pk3", "w") as archive:
        archive.writestr("maps/small.bsp", bsp(names, faces, vertices, [0, 1, 2, 0, 2, 3]))
        archive.writestr("maps/broken.bsp", b"IBSP" + (47).to_bytes(4, "little") + bytes(200))
        archive.writestr("textures/a/red.png", png((255, 0, 0)))
        archive.writestr("textures/a/green.png", png((0, 255, 0)))
        archive.writestr("scripts/a.shader", script)
    return quake.GameFiles([tmp_path / "pak.pk3"])


def test_visible_surfaces_come_out_in_metres_and_blended_ones_are_left_out(
    game: quake.GameFiles,
) -> None:
    scene = quake.load_map(game, "maps/small.bsp")
    colors = [tuple(t[0, 0]) for t in scene.textures]
    assert colors == [(255, 0, 0), (0, 255, 0)]
    assert scene.vertices["position"][:, :2].max() == pytest.approx(1.0)
    assert scene.viewpoints.tolist() == [[1.0, 2.0, 3.0]]


def test_a_bezier_patch_passes_half_way_to_its_middle_control_points(game: quake.GameFiles) -> None:
    scene = quake.load_map(game, "maps/small.bsp")
    patch = scene.vertices["position"][scene.vertices["texture"] == 1]
    assert patch[:, 2].max() == pytest.approx(0.5)
    assert len(patch) == (quake.PATCH_STEPS + 1) ** 2


def test_another_version_is_refused_with_the_name(game: quake.GameFiles) -> None:
    with pytest.raises(quake.MapError, match=r"maps/broken\.bsp.*version 46"):
        quake.load_map(game, "maps/broken.bsp")


def test_no_archive_is_an_error_that_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="pk3"):
        quake.GameFiles([tmp_path / "nothing.txt"])


@pytest.mark.parametrize("packed", [False, True])
def test_targa_rows_and_channels_come_out_right(packed: bool) -> None:
    pixels = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    body = io.BytesIO()
    for row in pixels[::-1]:  # without the flag, the first row in the file is the lowest
        if packed:
            body.write(bytes([0x80 | 0]) + row[0, ::-1].tobytes())
            body.write(bytes([1]) + row[1:, ::-1].tobytes())
        else:
            body.write(row[:, ::-1].tobytes())
    header = bytearray(18)
    header[2], header[12], header[14], header[16] = (10 if packed else 2), 3, 2, 24
    np.testing.assert_array_equal(quake.decode_tga(bytes(header) + body.getvalue()), pixels)


def test_a_truncated_targa_is_none() -> None:
    header = bytearray(18)
    header[2], header[12], header[14], header[16] = 2, 30, 20, 24
    assert quake.decode_tga(bytes(header) + bytes(50)) is None


def test_shader_scripts_say_what_is_hidden() -> None:
    text = """
    // a comment { with a brace
    textures/s/sky { surfaceparm sky }
    textures/s/wall { qer_editorimage textures/s/w.tga
        { map $lightmap } { map textures/s/glow.tga } }
    textures/s/fence { { map textures/s/f.tga
        alphaFunc GE128 } }
    """
    shaders = quake.parse_shaders(text)
    assert shaders["textures/s/sky"].hidden
    assert shaders["textures/s/fence"].hidden
    wall = shaders["textures/s/wall"]
    assert (wall.image, wall.editor_image, wall.hidden) == (
        "textures/s/glow.tga",
        "textures/s/w.tga",
        False,
    )


def test_a_packed_map_is_the_same_map_and_a_broken_one_is_left_out(
    game: quake.GameFiles, tmp_path: Path
) -> None:
    files, rng = RecordedFiles(game.paths), np.random.default_rng(0)
    assert pack_maps(files, tmp_path / "small.pk3", 100_000, rng) == ["maps/small.bsp"]
    packed = quake.GameFiles([tmp_path / "small.pk3"])
    before, after = (quake.load_map(g, "maps/small.bsp") for g in (game, packed))
    np.testing.assert_array_equal(after.vertices, before.vertices)
    np.testing.assert_allclose(after.textures, before.textures, atol=3)  # JPEG
    assert pack_maps(files, tmp_path / "none.pk3", 500, rng) == []
    assert not (tmp_path / "none.pk3").exists()
