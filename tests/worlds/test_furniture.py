"""Furniture libraries: a made library of one model comes back in its catalogue's size."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from benchmarks.pack_art import pack, pack_furniture
from dyfn_worlds.rooms.furniture import Showroom, read_library

CATALOGUE = """id=Made
name#1=Small table
category#1=Living room
model#1=/made/table.obj
width#1=120
depth#1=60
height#1=75
elevation#1=10
name#2=Without a model file
model#2=/made/missing.obj
"""
MODEL = """mtllib table.mtl
v 0 0 0
v 2 0 0
v 2 0.5 0
v 0 1 3
usemtl red
f 1 2 3
f 1 2 4
"""
MATERIAL = "newmtl red\nKd 1.0 0.0 0.0\nd 1.0\n"


@pytest.fixture
def library(tmp_path: Path) -> Path:
    path = tmp_path / "made.sh3f"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", CATALOGUE)
        archive.writestr("made/table.obj", MODEL)
        archive.writestr("made/table.mtl", MATERIAL)
    return path


def test_a_piece_has_its_catalogue_size_and_only_present_models_count(library: Path) -> None:
    showroom = Showroom([library])
    (piece,) = showroom.pieces
    assert piece.size == (1.2, 0.6, 0.75)
    assert piece.elevation == pytest.approx(0.1)
    points = np.concatenate([p.positions for p in showroom.parts(piece)])
    np.testing.assert_allclose(points.min(axis=0), [-0.6, -0.3, 0.0], atol=1e-6)
    np.testing.assert_allclose(points.max(axis=0), [0.6, 0.3, 0.75], atol=1e-6)


def test_the_front_of_a_model_turns_away_from_the_wall_behind_it(library: Path) -> None:
    showroom = Showroom([library])
    points = np.concatenate([p.positions for p in showroom.parts(showroom.pieces[0])])
    # in the model z = 3 (its front) is at y = 1 (its top)
    assert points[np.argmax(points[:, 2])][1] == pytest.approx(-0.3)


def test_a_file_without_a_catalogue_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "other.sh3f"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(ValueError, match=r"other\.sh3f"):
        read_library(path)


def test_a_packed_piece_is_the_same_piece(library: Path, tmp_path: Path) -> None:
    (piece,) = read_library(library)
    assert pack_furniture([piece], tmp_path / "small.sh3f", 10_000) == 1
    (packed,) = (small := Showroom([tmp_path / "small.sh3f"])).pieces
    assert (packed.name, packed.category) == (piece.name, piece.category)
    assert packed.size == pytest.approx(piece.size)
    for before, after in zip(Showroom([library]).parts(piece), small.parts(packed), strict=True):
        np.testing.assert_allclose(after.positions, before.positions, atol=1e-6)
        np.testing.assert_array_equal(after.color, before.color)
    assert pack_furniture([piece], tmp_path / "none.sh3f", 100) == 0


def test_art_without_anything_to_render_from_is_refused(tmp_path: Path) -> None:
    (tmp_path / "art").mkdir()
    with pytest.raises(FileNotFoundError, match="no furniture, map, photograph or texture"):
        pack(tmp_path / "art", tmp_path / "out", 1.0)
