"""A small copy of the art that dyfn-worlds renders from, for a machine that is lent for minutes.

    python benchmarks/pack_art.py ART out/art --megabytes 12

OUT gets furniture.sh3f, maps.pk3, photos/ and textures/: a seeded draw of whole pieces, maps,
players and pictures, each kind up to its share of the size; pictures are shrunk. Licences are
those of the art.
"""

from __future__ import annotations

import argparse
import re
import shutil
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from dyfn_worlds.generate import HELD_OUT_MAPS
from dyfn_worlds.maps import md3
from dyfn_worlds.maps.quake import GameFiles, MapError, load_map
from dyfn_worlds.rooms.furniture import Piece, read_library
from dyfn_worlds.scene.builder import SceneBuilder
from dyfn_worlds.scene.palette import Palette

# of the size; furniture and materials are what rooms are made of
SHARES = {"furniture": 0.45, "textures": 0.2, "photos": 0.1, "maps": 0.25}
LARGEST = 0.25  # of a kind's share, for one thing: many small ones rather than few large ones
CATALOGUE = "PluginFurnitureCatalog.properties"
SIDE = {"furniture": 192, "textures": 384, "photos": 512, "maps": 192}  # of a picture, at most


class RecordedFiles(GameFiles):
    """Keeps the names of what is read after it was opened."""

    def __init__(self, paths: list[Path]) -> None:
        self.seen: set[str] = set()
        super().__init__(paths)
        self.scripts, self.seen = self.seen, set()

    def read(self, name: str) -> bytes:
        self.seen.add(name.lower())
        return super().read(name)

    def newly_read(self) -> set[str]:
        """What was read since the last call; pictures are forgotten, so that they are read anew."""
        found, self.seen = self.seen, set()
        self._images.clear()
        return found


def shrunk(data: bytes, side: int, suffix: str) -> bytes | None:
    """A picture of that many pixels in the shorter side, or less; None when it is none."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    scale = side / min(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 85] if suffix in (".jpg", ".jpeg") else []
    return bytes(cv2.imencode(suffix, image, quality)[1])


def compressed(members: dict[str, bytes]) -> int:
    """Bytes that the members take in a zip file, nearly."""
    return sum(len(zlib.compress(data, 6)) for data in members.values())


def within(
    limit: int, things: Iterable[dict[str, bytes]]
) -> Iterator[tuple[dict[str, bytes], int]]:
    """The things whose bytes together stay within the limit, none above LARGEST of it."""
    used = 0
    for members in things:
        size = compressed(members)
        if members and size <= LARGEST * limit and used + size <= limit:
            used += size
            yield members, size


def pack_pictures(files: list[Path], kind: str, out: Path, limit: int) -> int:
    """Shrunk copies in OUT/KIND; how many."""
    folder = out / kind
    folder.mkdir(parents=True)
    things = (_picture(path, number, SIDE[kind]) for number, path in enumerate(files))
    count = 0
    for members, _ in within(limit, things):
        for name, data in members.items():
            (folder / name).write_bytes(data)
            count += 1
    return count


def _picture(path: Path, number: int, side: int) -> dict[str, bytes]:
    data = shrunk(path.read_bytes(), side, ".jpg")
    return {} if data is None else {f"{number:04d}.jpg": data}


def pack_furniture(pieces: list[Piece], path: Path, limit: int) -> int:
    """One library of those pieces that fit; how many."""
    entries: list[str] = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as library:
        written: set[str] = set()
        things = ({"": str(i).encode(), **_model_files(piece)} for i, piece in enumerate(pieces))
        for members, _ in within(limit, things):
            piece = pieces[int(members.pop(""))]
            for name, data in members.items():
                if name not in written:
                    library.writestr(name, data)
                    written.add(name)
            entries.append(_entry(piece, len(entries) + 1))
        library.writestr(CATALOGUE, "id=packed\n" + "\n".join(entries))
    return len(entries)


def _model_files(piece: Piece) -> dict[str, bytes]:
    """A model, its materials and their shrunk pictures, below a folder of its library's name."""
    with zipfile.ZipFile(piece.origin) as archive:
        names = set(archive.namelist())
        folder = PurePosixPath(piece.model).parent
        members = {piece.model: archive.read(piece.model)}
        libraries = _named(members[piece.model], rb"mtllib")
        for library in [str(folder / name) for name in libraries]:
            if library not in names:
                continue
            members[library] = archive.read(library)
            for name in _named(members[library], rb"map_\w+"):
                image, suffix = str(folder / name), PurePosixPath(name).suffix.lower()
                if image in names and (
                    data := shrunk(archive.read(image), SIDE["furniture"], suffix)
                ):
                    members[image] = data
    return {f"{piece.origin.stem}/{name}": data for name, data in members.items()}


def _named(text: bytes, key: bytes) -> list[str]:
    found = re.findall(rb"^\s*" + key + rb"\s+(.+?)\s*$", text, re.MULTILINE)
    return [name.decode("latin-1") for name in found]


def _entry(piece: Piece, number: int) -> str:
    width, depth, height = (100 * side for side in piece.size)
    values = {
        "name": piece.name,
        "category": piece.category,
        "model": f"/{piece.origin.stem}/{piece.model}",
        "width": width,
        "depth": depth,
        "height": height,
        "elevation": 100 * piece.elevation,
        "modelRotation": " ".join(map(str, piece.rotation)),
        "doorOrWindow": str(piece.is_opening).lower(),
    }
    return "\n".join(f"{key}#{number}={value}" for key, value in values.items())


def pack_maps(files: RecordedFiles, path: Path, limit: int, rng: np.random.Generator) -> list[str]:
    """One archive of maps and players, with the pictures that they need; their names."""
    names = [*files.maps(), *md3.players(files)]
    names = [
        name for name in rng.permutation(names) if PurePosixPath(name).stem not in HELD_OUT_MAPS
    ]
    chosen: list[str] = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for script in sorted(files.scripts):
            archive.writestr(script, files.read(script))
        written = set(files.scripts)
        found = ((name, _game_files(files, name)) for name in names)
        things = ({"": name.encode(), **members} for name, members in found if members)
        for members, _ in within(limit - compressed({s: files.read(s) for s in written}), things):
            chosen.append(members.pop("").decode())
            for name, data in members.items():
                if name not in written:
                    archive.writestr(name, data)
                    written.add(name)
    if not chosen:
        path.unlink()
    return chosen


def _game_files(files: RecordedFiles, name: str) -> dict[str, bytes]:
    """All that a map, or a player in its first skin, reads; nothing for one that is unusable."""
    files.newly_read()
    try:
        if name.startswith("maps/"):
            load_map(files, name, 45.0)
        else:
            skin = md3.skins(files, name)[0]
            md3.load_player(files, name, skin, 1.75, SceneBuilder(), 0, lambda image: image)
    except (MapError, md3.ModelError, IndexError):
        return {}
    members: dict[str, bytes] = {}
    for member in sorted(files.newly_read()):
        data = files.read(member)
        stem, suffix = member.rpartition(".")[::2]
        if suffix in ("tga", "jpg", "png") and (small := _game_picture(files, member)):
            members[f"{stem}.jpg"] = small
        else:
            members[member] = data
    return members


def _game_picture(files: RecordedFiles, member: str) -> bytes | None:
    image = files.image(member)
    if image is None:
        return None
    plain = bytes(cv2.imencode(".png", image[..., ::-1])[1])
    return shrunk(plain, SIDE["maps"], ".jpg")


def pack(art: Path, out: Path, megabytes: float, seed: int = 0) -> dict[str, int]:
    """Writes the copy anew; how many things of each kind it has.

    Raises FileNotFoundError when there is nothing to pack.
    """
    rng = np.random.default_rng(seed)
    limits = {kind: int(share * megabytes * 1e6) for kind, share in SHARES.items()}
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    palette = Palette.find(art)
    counts = {}
    for kind, files in (("photos", palette.photographs), ("textures", palette.materials)):
        drawn = [files[i] for i in rng.permutation(len(files))]
        counts[kind] = pack_pictures(drawn, kind, out, limits[kind])
    pieces = [piece for path in sorted(art.rglob("*.sh3f")) for piece in read_library(path)]
    if pieces:
        drawn_pieces = [pieces[i] for i in rng.permutation(len(pieces))]
        counts["pieces"] = pack_furniture(drawn_pieces, out / "furniture.sh3f", limits["furniture"])
    archives = sorted(art.rglob("*.pk3"))
    if archives:
        chosen = pack_maps(RecordedFiles(archives), out / "maps.pk3", limits["maps"], rng)
        counts["maps"] = sum(name.startswith("maps/") for name in chosen)
        counts["players"] = len(chosen) - counts["maps"]
    if not any(counts.values()):
        raise FileNotFoundError(f"{art}: no furniture, map, photograph or texture in it")
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("art", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--megabytes", type=float, default=12.0, help="of the copy, at most")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    counts = pack(options.art, options.out, options.megabytes, options.seed)
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    print(f"{options.out}: {size / 1e6:.1f} MB,", ", ".join(f"{n} {k}" for k, n in counts.items()))


if __name__ == "__main__":
    main()
