"""Files that are not where or what their names say."""

import gzip
import io
import tarfile
import zipfile
from pathlib import Path

import pytest
import yaml
import zstandard
from rosbags.rosbag2 import StoragePlugin

from dyfn_ros.recordings.open import RecordingError, open_recording
from dyfn_ros.recordings.storage.open import open_storage
from tests.support.made_recordings import make, shade, write_mcap, write_rosbag2

COUNT = 6


def folder(path: Path, names: dict[str, range], listed: list[str], count: int = COUNT) -> Path:
    """A recording of files with these messages, and what metadata.yaml says of them."""
    path.mkdir()
    for name, indices in names.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        write_mcap(path / name, indices)
    content = {"version": 9, "message_count": count, "relative_file_paths": listed}
    text = yaml.safe_dump({"rosbag2_bagfile_information": content})
    (path / "metadata.yaml").write_text(text)
    return path


def check(path: Path, indices: range = range(COUNT)) -> list[str]:
    """The images are these, in order; nothing is lost. Returns the warnings."""
    recording = open_recording(path)
    assert recording.expected_frames == len(indices)
    first = [int(frame.image[0, 0, 0]) for frame in recording.frames()]
    assert first == [int(shade(index)[0, 0, 0]) for index in indices]
    assert not recording.notes.losses
    return [*recording.notes.warnings]


HALVES = {"a.mcap": range(3), "b.mcap": range(3, 6)}


@pytest.mark.parametrize(
    ("names", "listed"),
    [
        ({"data/a.mcap": range(COUNT)}, ["data/a.mcap"]),
        ({"data/a.mcap": range(COUNT)}, ["data\\a.mcap"]),
        ({"1/a.mcap": range(3), "2/a.mcap": range(3, 6)}, ["1/a.mcap", "2/a.mcap"]),
        ({"a.mcap": range(COUNT)}, ["old_name/a.mcap"]),
        ({"a.mcap": range(COUNT)}, ["a.mcap.zstd"]),
        (HALVES, ["a.mcap.zstd", "b.mcap.zst"]),
        (HALVES, ["a.mcap", "a.mcap", "b.mcap"]),
        (HALVES, ["a.mcap", "./a.mcap", "old/a.mcap", "b.mcap"]),
    ],
)
def test_files_are_found_where_they_are_and_read_once(
    tmp_path: Path, names: dict[str, range], listed: list[str]
) -> None:
    assert check(folder(tmp_path / "bag", names, listed)) == []


def test_a_file_packed_by_hand_is_read(tmp_path: Path) -> None:
    bag = folder(tmp_path / "bag", {"a.mcap": range(COUNT)}, ["a.mcap"])
    (bag / "a.mcap.zst").write_bytes(zstandard.compress((bag / "a.mcap").read_bytes()))
    (bag / "a.mcap").unlink()
    assert check(bag) == []


@pytest.mark.parametrize("listed", [["x.mcap"], ["x_0.mcap", "x_1.mcap"]])
def test_renamed_files_with_all_messages_are_no_loss(tmp_path: Path, listed: list[str]) -> None:
    names = HALVES if len(listed) == 2 else {"a.mcap": range(COUNT)}
    warnings = check(folder(tmp_path / "bag", names, listed))
    expected = [f"{tmp_path / 'bag' / n}: metadata.yaml names it otherwise" for n in names]
    assert warnings == expected


def test_one_of_two_renamed_keeps_its_place(tmp_path: Path) -> None:
    bag = folder(
        tmp_path / "bag", {"z.mcap": range(3), "b.mcap": range(3, 6)}, ["a.mcap", "b.mcap"]
    )
    assert len(check(bag)) == 1


def test_another_recording_is_not_taken_for_a_missing_part(tmp_path: Path) -> None:
    names = {"a.mcap": range(3), "other.mcap": range(7, 9)}
    recording = open_recording(folder(tmp_path / "bag", names, ["a.mcap", "b.mcap"]))
    assert len(list(recording.frames())) == 3
    (loss,) = recording.notes.losses
    assert loss.endswith("b.mcap: missing, though metadata.yaml lists it")
    (warning,) = recording.notes.warnings
    assert warning.endswith("other.mcap: not read, metadata.yaml does not list it")


@pytest.mark.parametrize("outside", ["../other.mcap", "{tmp}/other.mcap", "data/../../other.mcap"])
def test_nothing_outside_the_folder_is_read(tmp_path: Path, outside: str) -> None:
    write_mcap(tmp_path / "other.mcap", range(2))
    listed = ["a.mcap", outside.format(tmp=tmp_path)]
    recording = open_recording(folder(tmp_path / "bag", {"a.mcap": range(3)}, listed))
    assert len(list(recording.frames())) == 3
    assert any("other.mcap: missing" in loss for loss in recording.notes.losses)


def test_the_folder_around_a_recording_names_it(tmp_path: Path) -> None:
    bag = folder(tmp_path / "bag", {"a.mcap": range(COUNT)}, ["a.mcap"])
    with pytest.raises(RecordingError, match=f"expected a rosbag2 folder.*it holds {bag}"):
        open_recording(tmp_path)


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [("zstd.mcap", ".db3"), ("zstd.mcap", ".bag"), ("plain.bag", ".mcap"), ("lz4.bag", ".db3")],
)
def test_a_file_with_anothers_suffix_is_read_as_what_it_is(
    tmp_path: Path, kind: str, suffix: str
) -> None:
    path = make(tmp_path, kind, COUNT).rename(tmp_path / f"walk{suffix}")
    check(path)


def test_a_database_named_mcap_is_read(tmp_path: Path) -> None:
    write_rosbag2(tmp_path / "bag", range(COUNT), StoragePlugin.SQLITE3)
    database = next((tmp_path / "bag").glob("*.db3"))
    check(database.rename(tmp_path / "walk.mcap"))


def zipped() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.mcap", b"x" * 100)
    return file.getvalue()


def tarred() -> bytes:
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w") as archive:
        entry = tarfile.TarInfo("a.mcap")
        entry.size = 100
        archive.addfile(entry, io.BytesIO(b"x" * 100))
    return file.getvalue()


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"a" * 64 + b"\nsize 12345\n"
OTHERS: dict[str, tuple[bytes, str]] = {
    "pointer": (POINTER, "is no recording but a Git LFS pointer: `git lfs pull`"),
    "page": (b"<!DOCTYPE html><html></html>", "but a web page, it begins with '<!DOCTYPE html>"),
    "error": (b"\n<?xml version='1.0'?><Error/>", r"but a web page, it begins with .\\n<\?xml"),
    "zip": (zipped(), "but a zip archive: unpack it"),
    "gzip": (gzip.compress(b"x" * 100), "but a gzip file: unpack it"),
    "tar": (tarred(), "but a tar archive: unpack it"),
    "old bag": (b"#ROSBAG V1.2\n" + b"x" * 100, "but a ROS 1 bag of format 1"),
    "zstd": (zstandard.compress(b"x" * 100), "is compressed by zstd: name it walk"),
    "text": (b"hello, this is no recording", "does not begin as an? .* does, it begins with 'hel"),
}


@pytest.mark.parametrize("name", [*OTHERS])
@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag"])
def test_what_is_no_recording_is_told_for_what_it_is(
    tmp_path: Path, name: str, suffix: str
) -> None:
    content, said = OTHERS[name]
    (tmp_path / f"walk{suffix}").write_bytes(content)
    with pytest.raises(RecordingError, match=said):
        open_recording(tmp_path / f"walk{suffix}")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("walk.zip", zipped(), "walk.zip is no recording but a zip archive: unpack it"),
        ("walk.tar.gz", gzip.compress(tarred()), "but a gzip file: unpack it"),
        ("walk.tar", tarred(), "but a tar archive: unpack it"),
        ("download", b"<html><body>Sign in</body></html>", "but a web page, it begins with"),
        ("walk", b"\x89MCAP0\r\n" + bytes(100), "it begins as an MCAP file does: name it so"),
        ("walk.rosbag", b"#ROSBAG V2.0\n" + bytes(9), "it begins as a ROS 1 bag .2.0. does"),
        ("photo.jpg", b"any", "a folder of pictures; depth of one picture: dyfn-depth .*photo.jpg"),
        ("walk.dat", b"some text", "expected a rosbag2 folder, an .mcap, .db3 or .bag file"),
        ("walk.mcap", b"", "walk.mcap is empty"),
    ],
)
def test_files_with_other_names_are_told_for_what_they_are(
    tmp_path: Path, name: str, content: bytes, said: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=said):
        open_recording(tmp_path / name)


@pytest.mark.parametrize("kind", ["zstd.mcap", "plain.bag", "packed.mcap.zstd"])
def test_suffixes_in_capitals_are_read(tmp_path: Path, kind: str) -> None:
    path = make(tmp_path, kind, COUNT)
    named = path.rename(tmp_path / path.name.upper())
    assert check(named) == []
    (tmp_path / "bag").mkdir()
    named.rename(tmp_path / "bag" / named.name)
    assert check(tmp_path / "bag") == []


def test_a_pointer_among_the_parts_is_a_loss_that_says_so(tmp_path: Path) -> None:
    bag = folder(tmp_path / "bag", HALVES, [*HALVES])
    (bag / "b.mcap").write_bytes(POINTER)
    storage = open_storage(bag)
    assert storage.losses == [
        f"{bag / 'b.mcap'} is no recording but a Git LFS pointer: `git lfs pull` fetches the "
        "recording"
    ]
    assert len(list(storage.messages({"/image"}))) == 3


@pytest.mark.parametrize("maker", ["zstd.mcap", "plain.bag"])
def test_damage_at_the_head_does_not_cost_the_rest(tmp_path: Path, maker: str) -> None:

    path = make(tmp_path, maker, COUNT)

    content = path.read_bytes()
    path.write_bytes(b"\0\0" + content[2:])
    assert len(list(open_recording(path).frames())) >= COUNT - 2
