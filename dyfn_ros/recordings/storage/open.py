"""Recordings of every kind opened: rosbag2 folders, bare MCAP, sqlite3 and ROS 1 files."""

from __future__ import annotations

import filecmp
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath

import yaml
import zstandard

from dyfn_core.data.files import hidden
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.pictures import is_picture_name
from dyfn_ros.recordings.storage.base import DAMAGE, Recorded, Storage, Topic, reason
from dyfn_ros.recordings.storage.heads import NAMES, kind_by_head, strange_head
from dyfn_ros.recordings.storage.mcap import McapFile
from dyfn_ros.recordings.storage.rosbag1 import Bag1File
from dyfn_ros.recordings.storage.sqlite import SqliteFile

__all__ = ["SUFFIXES", "Recorded", "Storage", "Topic", "is_recording", "open_storage"]

READERS: dict[str, Callable[[Path], Storage]] = {
    ".mcap": McapFile,
    ".db3": SqliteFile,
    ".bag": Bag1File,
    ".active": Bag1File,  # a ROS 1 bag that was not closed: x.bag.active
}
SUFFIXES = (".mcap", ".db3", ".bag", ".bag.active")
PACKED = (".zstd", ".zst")  # rosbag2's compression by file
ARCHIVES = (".zip", ".tar", ".tgz", ".gz", ".bz2", ".xz", ".7z", ".rar")
EXPECTED = (
    "a rosbag2 folder, an .mcap, .db3 or .bag file (also .zstd of one), an RGB-D folder, a video "
    "file or a folder of pictures"
)
_NAMED = 8  # parts that a loss names
_FREE = 1 << 30  # bytes that unpacking leaves on the disk


class ChainedStorage:
    """Several files of one recording, one after the other.

    losses: of what was no readable file at all.
    """

    def __init__(
        self, parts: Sequence[Storage], losses: Sequence[str] = (), remarks: Sequence[str] = ()
    ) -> None:
        self.parts = parts
        self.remarks = remarks
        self._lost = losses
        self.topics: dict[str, Topic] = {}
        for part in parts:
            for name, topic in part.topics.items():
                known = self.topics.get(name, Topic(topic.kind, 0))
                self.topics[name] = Topic(known.kind, known.count + topic.count)

    @property
    def losses(self) -> list[str]:
        """See Storage."""
        return [*self._lost, *(loss for part in self.parts for loss in part.losses)]

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        """See Storage."""
        for part in self.parts:
            yield from part.messages(topics)


class UnpackedStorage(ChainedStorage):
    """A .zstd file, unpacked into a temporary folder that lives as long as this object."""

    def __init__(self, path: Path) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="dyfn-")
        inside = Path(self._folder.name) / path.stem
        problem = _unpack(path, inside)
        try:
            super().__init__([_open_file(inside)], [f"{path}: {problem}"] if problem else [])
        except RecordingError as error:
            raise RecordingError(f"{path}: {problem or error}") from error


def is_recording(path: Path) -> bool:
    """Whether a path looks like a recording: by its name, or by what a folder holds."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or bool(_files(path))
    return _is_file(path)


def open_storage(path: str | Path) -> Storage:
    """Open a rosbag2 folder (with or without metadata.yaml) or a bare file of SUFFIXES.

    What can be read is used, also behind damage, and the loss is reported in `losses`. Raises
    RecordingError when nothing can be read, saying what was expected.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError(f"{path} does not exist")
    storage: Storage = _open_folder(path) if path.is_dir() else _open_file(path)
    if not any(topic.count for topic in storage.topics.values()):
        reasons = "; ".join(storage.losses) or "it holds no messages"
        raise RecordingError(f"{path}: nothing to read: {reasons}")
    return storage


def _is_file(path: Path) -> bool:
    return _plain_name(path).lower().endswith(SUFFIXES)


def _files(folder: Path) -> list[Path]:
    """Recordings in a folder in natural order of their names, each once."""
    found = {
        _plain_name(f): f
        for f in sorted(folder.iterdir(), key=lambda f: f.suffix not in PACKED)
        if _is_file(f) and f.is_file() and not hidden(f)
    }
    return sorted(found.values(), key=lambda f: _natural(f.name))


def _natural(name: str) -> list[int | str]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def _open_folder(path: Path) -> Storage:
    contents = _contents(path)
    if not contents.files:
        inner = [d for d in sorted(path.iterdir()) if d.is_dir() and is_recording(d)]
        held = f"; it holds {', '.join(map(str, inner))}" if inner else _other_contents(path)
        raise RecordingError(
            f"{path}: expected a rosbag2 folder (metadata.yaml and .mcap or .db3 files) "
            f"or an RGB-D folder (rgb/, depth/, K.txt){held}{contents.problem}"
            f"{''.join(f'; {text}' for text in contents.missing)}"
        )
    parts: dict[Path, Storage] = {}
    losses: list[str] = []
    for file in contents.files:
        try:
            parts[file] = _open_file(file)
        except RecordingError as error:
            losses.append(str(error))
    if not parts:
        raise RecordingError("; ".join([*contents.missing, *losses]))
    found = sum(topic.count for part in parts.values() for topic in part.topics.values())
    parts, remarks = _in_time(path, parts)
    if contents.renamed and not losses and found == contents.messages:
        remarks += [f"{f}: metadata.yaml names it otherwise" for f in contents.renamed]
        return ChainedStorage([*parts.values()], (), remarks)
    damaged = losses or contents.missing or any(part.losses for part in parts.values())
    others = contents.renamed or contents.unlisted
    if not damaged and not others and contents.messages is not None and found < contents.messages:
        losses.append(
            f"{path}: metadata.yaml counts {contents.messages} messages, {found} are there"
        )
    listed = {file: part for file, part in parts.items() if file not in contents.renamed}
    unlisted = [*contents.unlisted, *(contents.renamed if listed else [])]
    remarks += [f"{f}: not read, metadata.yaml does not list it" for f in unlisted]
    remarks += [
        f"{f}: not read, a copy of another file, by its name or bytes" for f in contents.copies
    ]
    return ChainedStorage([*(listed or parts).values()], [*contents.missing, *losses], remarks)


def _other_contents(folder: Path) -> str:
    """Archives, and folders that may be of pictures, as the end of an error."""
    entries = sorted(entry for entry in folder.iterdir() if not hidden(entry))
    packed = [entry.name for entry in entries if entry.name.lower().endswith(ARCHIVES)]
    if packed:
        return f"; it holds {', '.join(packed[:_NAMED])}: unpack"
    folders = [f"{entry.name}/" for entry in entries if entry.is_dir()]
    if folders:
        return (
            f"; it holds {', '.join(folders[:_NAMED])}: a folder of pictures alone is read, "
            "without depth"
        )
    return ""


def _in_time(folder: Path, parts: dict[Path, Storage]) -> tuple[dict[Path, Storage], list[str]]:
    """Parts in the order of their first messages, and a sentence when that is another one."""
    if len(parts) == 1:
        return parts, []
    starts: dict[Path, int] = {}
    last = 0
    for file, part in parts.items():
        first = next(iter(part.messages([*part.topics])), None)
        last = starts[file] = last if first is None else first.log_ns
    ordered = sorted(parts, key=lambda file: starts[file])
    if ordered == [*parts]:
        return parts, []
    told = f"{folder}: its files are read in the order of their first messages, not as listed"
    return {file: parts[file] for file in ordered}, [told]


@dataclass
class _Contents:
    """The files of a folder, in the order of recording.

    missing: sentences about files that metadata.yaml lists and that are not there. renamed:
    those of `files` that may be the missing ones. unlisted: the others that are not listed.
    copies: those that are one of `files` again, in another format or by another name. messages:
    how many there are by metadata.yaml. problem: why that cannot be used.
    """

    files: list[Path]
    missing: list[str] = field(default_factory=list)
    renamed: list[Path] = field(default_factory=list)
    unlisted: list[Path] = field(default_factory=list)
    copies: list[Path] = field(default_factory=list)
    messages: int | None = None
    problem: str = ""


def _contents(path: Path) -> _Contents:
    """What there is, by metadata.yaml when that can be read."""
    unlisted = _files(path)
    if not (path / "metadata.yaml").exists():
        files, copies = _without_copies(unlisted)
        return _Contents(files, _missing_numbers(path, files), copies=copies)
    try:
        names, messages = _listed(path / "metadata.yaml")
    except (*DAMAGE, yaml.YAMLError) as error:  # the files speak for themselves
        problem = f"; metadata.yaml is not the YAML of a recording: {reason(error)}"
        files, copies = _without_copies(unlisted)
        return _Contents(files, _missing_numbers(path, files), copies=copies, problem=problem)
    places = {name: _place(path, name) for name in names}
    found = [*dict.fromkeys(place for place in places.values() if place is not None)]
    unlisted = [f for f in unlisted if _plain_name(f) not in {_plain_name(p) for p in found}]
    missing = [
        f"{path / name}: missing, though metadata.yaml lists it"
        for name, place in places.items()
        if place is None
    ]
    if missing and len(unlisted) == len(missing):
        stand_in = iter(unlisted)
        all_files = dict.fromkeys(place or next(stand_in) for place in places.values())
        return _Contents([*all_files], missing, renamed=unlisted, messages=messages)
    if not found:
        return _Contents(unlisted, missing, messages=messages)
    return _Contents(found, missing, unlisted=unlisted, messages=messages)


def _without_copies(files: list[Path]) -> tuple[list[Path], list[Path]]:
    """Files that differ, and those that are the same: in another format by their names, or byte for
    byte by another name."""
    kept: dict[str, Path] = {}
    for file in sorted(files, key=lambda f: [*READERS].index(Path(_plain_name(f)).suffix.lower())):
        kept.setdefault(_stem(file), file)
    different: list[Path] = []
    for file in sorted(files, key=lambda f: len(f.name)):  # `walk (1).mcap` is the copy
        same = any(_same_bytes(file, other) for other in different)
        if kept[_stem(file)] == file and not same:
            different.append(file)
    return [f for f in files if f in different], [f for f in files if f not in different]


def _same_bytes(one: Path, other: Path) -> bool:
    """Whether two files hold the same; they are read when they are of one size."""
    try:
        return one.stat().st_size > 0 and filecmp.cmp(one, other, shallow=False)
    except OSError:
        return False


def _stem(path: Path) -> str:
    """Without all of the suffixes of a recording."""
    return re.sub(r"(?i)\.(?:mcap|db3|bag|bag\.active)$", "", _plain_name(path))


def _missing_numbers(folder: Path, files: list[Path]) -> list[str]:
    """Sentences about the parts NAME_0, NAME_1, ... that are not there between others.

    The first is number 0 where NAME is the folder's, as rosbag2 names parts.
    """
    parts = [re.fullmatch(r"(.+)_(\d+)", _plain_name(file).split(".")[0]) for file in files]
    names = {part.group(1) if part else None for part in parts}
    if len(names) != 1 or None in names:
        return []
    (name,) = names
    numbers = sorted({int(part.group(2)) for part in parts if part})
    first = 0 if name == folder.name else numbers[0]
    missing = sorted({*range(first, numbers[-1])} - {*numbers})
    if not missing:
        return []
    listed = ", ".join(f"{name}_{number}" for number in missing[:_NAMED])
    more = ", ..." if missing[_NAMED:] else ""
    return [f"{folder}: {listed}{more} missing, by the names of the other parts"]


def _listed(metadata: Path) -> tuple[list[str], int | None]:
    """File names in the order of recording, each once, and how many messages they hold."""
    with metadata.open("rb") as file:
        content = yaml.safe_load(file)["rosbag2_bagfile_information"]
    names = [str(name).replace("\\", "/") for name in content["relative_file_paths"]]
    by_name = {os.path.normpath(name): name for name in names}
    count = content.get("message_count")
    return [*by_name.values()], count if isinstance(count, int) else None


def _place(folder: Path, name: str) -> Path | None:
    """A listed file: where metadata.yaml says, or beside it, packed or unpacked by hand.

    Old versions have the folder's name before the file's. Never outside the folder.
    """
    inside = not PurePath(name).is_absolute() and ".." not in PurePath(name).parts
    beside = folder / PurePath(name).name
    for stem in (folder / name, beside) if inside else (beside,):
        plain = stem.with_suffix("") if stem.suffix in PACKED else stem
        packed = [plain.with_name(plain.name + suffix) for suffix in PACKED]
        for place in (stem, plain, *packed):
            if place.is_file():
                return place
    return None


def _plain_name(path: Path) -> str:
    return path.stem if path.suffix.lower() in PACKED else path.name


def _open_file(path: Path) -> Storage:
    if path.stat().st_size == 0:
        raise RecordingError(f"{path} is empty")
    own = path.suffix.lower()
    packed = own in PACKED
    suffix = kind_by_head(path, packed) or own
    if not _is_file(path):
        hint = f"; it begins as {NAMES[suffix]} does: name it so" if suffix in NAMES else ""
        if is_picture_name(path):
            hint = f"; depth of one picture: dyfn-depth {path}"
        raise RecordingError(f"{path}: expected {EXPECTED}{hint}")
    if packed and suffix == own:
        return UnpackedStorage(path)
    try:
        storage = READERS[suffix](path)
    except DAMAGE as error:
        raise RecordingError(f"{path} is not a readable recording: {reason(error)}") from error
    if not storage.topics:
        strange = strange_head(path, suffix)
        reasons = "; ".join(filter(None, [strange, *storage.losses])) or "it holds no messages"
        raise RecordingError(f"{path} is not a readable recording: {reasons}")
    return storage


def _unpack(path: Path, target: Path) -> str:
    """Unpack as much as can be, of one frame of zstd after the other (pzstd writes many).

    Says what went wrong, "" when nothing did.
    """
    unpacker = zstandard.ZstdDecompressor()
    decoder = unpacker.decompressobj()
    try:
        with path.open("rb") as source, target.open("wb") as file:
            while piece := decoder.unused_data or source.read(1 << 10):  # gives at most 32 MiB
                if decoder.eof:
                    decoder = unpacker.decompressobj()
                file.write(decoder.decompress(piece))
                if shutil.disk_usage(target.parent).free < _FREE:
                    return f"unpacked up to {file.tell()} bytes, then the disk was full"
    except DAMAGE as error:
        return f"unpacked in part: {reason(error)}"
    return "" if decoder.eof else "the compressed file ends early"
