"""Every storage and every kind of damage: what can be read is read, what is lost is said."""

import shutil
import sqlite3
import struct
import tracemalloc
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.storage.base import MOST_LOSSES, Recorded, decompress
from dyfn_ros.recordings.storage.chunked import MAX_OPEN, Span, merged
from dyfn_ros.recordings.storage.open import is_recording, open_storage
from dyfn_ros.recordings.typestore import IMAGE
from tests.support.made_recordings import (
    MAKERS,
    TOPIC,
    image_bytes,
    largest_file,
    make,
    shade,
    stamp_ns,
    write_mcap,
)

COUNT = 24


def indices(path: Path) -> tuple[list[int], list[str]]:
    """Numbers of the messages that are read whole, and the losses."""
    storage = open_storage(path)
    found = []
    for recorded in storage.messages([TOPIC]):
        message = recorded.message()
        index = int(message.data[0])
        assert np.array_equal(message.data.reshape(24, 32, 3), shade(index))
        assert recorded.log_ns == stamp_ns(index)
        found.append(index)
    return found, storage.losses


@pytest.mark.parametrize("kind", MAKERS)
def test_every_storage_gives_the_messages_back(tmp_path: Path, kind: str) -> None:
    path = make(tmp_path, kind, 7)
    storage = open_storage(path)
    assert is_recording(path)
    assert {name: (t.kind, t.count) for name, t in storage.topics.items()} == {TOPIC: (IMAGE, 7)}
    for _ in range(2):  # again and again
        found = list(storage.messages([TOPIC]))
        assert [r.log_ns for r in found] == [stamp_ns(index) for index in range(7)]
        assert [r.data for r in found] == [image_bytes(index) for index in range(7)]
    assert list(storage.messages(["/other"])) == []
    assert storage.losses == []


@pytest.mark.parametrize("kind", [k for k in MAKERS if "." not in k])
def test_a_folder_without_metadata_is_read(tmp_path: Path, kind: str) -> None:
    path = make(tmp_path, kind, 6)
    (path / "metadata.yaml").unlink()
    for name in ("._a.mcap", "._a.db3"):  # what macOS leaves beside a copied file
        (path / name).write_bytes(b"\0\5\x16\7")
    found, losses = indices(path)
    assert sorted(found) == list(range(6))
    assert losses == []
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    assert sorted(indices(path)[0]) == list(range(6))


def test_a_file_of_a_split_recording_that_is_missing_is_a_loss(tmp_path: Path) -> None:
    path = make(tmp_path, "split", 9)
    (path / "a.mcap").unlink()
    found, losses = indices(path)
    assert found == [0, 1, 2, 6, 7, 8]
    assert len(losses) == 1 and "a.mcap: missing, though metadata.yaml lists it" in losses[0]
    (path / "b.mcap").write_bytes(b"")
    found, losses = indices(path)
    assert found == [0, 1, 2]
    assert "b.mcap is empty" in losses[1]


def cut(data: bytes) -> bytes:
    return data[: len(data) * 2 // 3]


BLOCK = 56  # messages that a block of zstd holds at most, which is read whole or not at all


@pytest.mark.parametrize("kind", [kind for kind in MAKERS if kind != "split"])
def test_a_truncated_recording_is_read_up_to_the_damage(tmp_path: Path, kind: str) -> None:
    blocks = kind == "mcap" or "file-zstd" in kind or "packed" in kind
    path = make(tmp_path, kind, 210 if blocks else COUNT)
    file = largest_file(path)
    file.write_bytes(cut(file.read_bytes()))
    found, losses = indices(path)
    assert found == list(range(len(found)))
    whole, least = (140, 140 - BLOCK - 4) if blocks else (16, 12)
    assert least <= len(found) <= whole
    assert losses and any(str(tmp_path) in loss for loss in losses)


@pytest.mark.parametrize("kind", ["zstd.mcap", "unchunked.mcap", "plain.bag", "sqlite3"])
def test_what_is_known_to_be_lost_counts_however_few_frames_are_read(
    tmp_path: Path, kind: str
) -> None:
    path = make(tmp_path, kind, 20)
    file = largest_file(path)
    file.write_bytes(cut(file.read_bytes()))
    recording = open_recording(path)
    with closing(recording.frames()) as frames:
        next(frames)
    few = [*recording.notes.losses]
    assert few
    assert len(list(recording.frames())) > 1
    assert [*recording.notes.losses] == few


def overwrite(file: Path, place: float, value: bytes) -> None:
    data = bytearray(file.read_bytes())
    start = int(len(data) * place)
    data[start : start + len(value)] = value
    file.write_bytes(data)


CHUNKED = ["zstd.mcap", "lz4.mcap", "plain.mcap", "unindexed.mcap", "bz2.bag"]


@pytest.mark.parametrize("kind", CHUNKED)
def test_a_bad_chunk_is_left_out_and_the_rest_is_read(tmp_path: Path, kind: str) -> None:
    path = make(tmp_path, kind, COUNT)
    overwrite(path, 0.5, b"\xa5" * 16)
    found, losses = indices(path)
    lost = sorted(set(range(COUNT)) - set(found))
    assert found == sorted(found)
    assert 1 <= len(lost) <= 3 and lost == list(range(lost[0], lost[-1] + 1))
    assert len(losses) == 1 and path.name in losses[0] and "damaged" in losses[0]


@pytest.mark.parametrize("size", [100, 6_000], ids=["small", "large"])
@pytest.mark.parametrize("kind", ["zstd.mcap", "plain.mcap", "unchunked.mcap", "lz4.bag"])
def test_garbage_in_place_of_records_is_passed_over(tmp_path: Path, kind: str, size: int) -> None:
    """The index of the file no longer fits, the frames of records are gone."""
    path = make(tmp_path, kind, COUNT)
    data = path.read_bytes()
    middle = len(data) // 2
    noise = np.random.default_rng(0).bytes(size)
    path.write_bytes(data[:middle] + noise + data[middle + size // 2 :])
    found, losses = indices(path)
    lost = sorted(set(range(COUNT)) - set(found))
    assert 1 <= len(lost) <= 6 and found == sorted(found)
    assert found[0] == 0 and found[-1] == COUNT - 1
    assert losses and all(path.name in loss for loss in losses)


@pytest.mark.parametrize("kind", ["zstd.mcap", "plain.mcap", "unchunked.mcap", "lz4.mcap"])
def test_a_damaged_summary_costs_nothing(tmp_path: Path, kind: str) -> None:
    path = make(tmp_path, kind, COUNT)
    data = bytearray(path.read_bytes())
    (start,) = struct.unpack("<Q", data[-28:-20])
    data[start + 9] ^= 0xFF
    path.write_bytes(data)
    assert indices(path) == (list(range(COUNT)), [])


@pytest.mark.parametrize("kind", ["zstd.mcap", "lz4.bag", "unchunked.mcap"])
def test_an_end_that_is_missing_is_a_loss_even_between_records(tmp_path: Path, kind: str) -> None:
    path = make(tmp_path, kind, 6)
    data = path.read_bytes()
    if kind.endswith("bag"):
        (start,) = struct.unpack("<Q", data[data.index(b"index_pos=") + 10 :][:8])
    else:
        (start,) = struct.unpack("<Q", data[-28:-20])
        start -= 9 + 4  # the end of the data section
    path.write_bytes(data[:start])
    found, losses = indices(path)
    assert found == list(range(6))
    assert len(losses) == 1 and "100%" in losses[0]


def test_a_ros1_bag_that_was_not_closed_is_read(tmp_path: Path) -> None:
    data = bytearray(make(tmp_path, "lz4.bag", 6).read_bytes())
    place = data.index(b"index_pos=") + 10
    (start,) = struct.unpack("<Q", data[place : place + 8])
    data[place : place + 8] = bytes(8)
    path = tmp_path / "x.bag.active"
    path.write_bytes(data[:start])
    found, losses = indices(path)
    assert found == list(range(6))
    assert len(losses) == 1 and "it was not closed" in losses[0]


def rows_of(path: Path) -> int:
    with closing(sqlite3.connect(path)) as database:
        return int(database.execute("SELECT count(*) FROM messages").fetchone()[0])


def test_a_bad_page_of_a_database_costs_its_rows_only(tmp_path: Path) -> None:
    file = largest_file(make(tmp_path, "sqlite3", COUNT))
    data = bytearray(file.read_bytes())
    place = data.index(image_bytes(11)[:64])  # the row's start, on a page of the tree
    page = place // 4096 * 4096
    data[page : page + 8] = b"\xff" * 8
    file.write_bytes(data)
    found, losses = indices(file)
    lost = sorted(set(range(COUNT)) - set(found))
    assert 11 in lost and len(lost) <= 4
    assert found == sorted(found)
    assert losses and all("sqlite3.db3" in loss for loss in losses)


def test_rows_that_are_no_messages_are_a_loss(tmp_path: Path) -> None:
    file = largest_file(make(tmp_path, "sqlite3", 6))
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("UPDATE messages SET data = 'text' WHERE id = 3")
    found, losses = indices(file)
    assert found == [0, 1, 3, 4, 5]
    assert len(losses) == 1 and "no message" in losses[0]


def test_a_write_ahead_log_beside_the_file_is_used(tmp_path: Path) -> None:
    file = largest_file(make(tmp_path, "sqlite3", 4))
    with closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA journal_mode = WAL")
        row = (1, stamp_ns(4), image_bytes(4))
        database.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
        database.commit()
        for name in ("x.db3", "x.db3-wal"):
            shutil.copy(str(file) + name[5:], tmp_path / name)
    assert indices(tmp_path / "x.db3") == ([0, 1, 2, 3, 4], [])


@pytest.mark.parametrize("suffix", [".mcap", ".db3", ".bag", ".bag.active", ".mcap.zstd"])
@pytest.mark.parametrize("content", [b"", bytes(5000), b"no recording at all", None])
def test_what_is_no_recording_is_refused(
    tmp_path: Path, suffix: str, content: bytes | None
) -> None:
    path = tmp_path / f"x{suffix}"
    path.write_bytes(np.random.default_rng(1).bytes(50_000) if content is None else content)
    with pytest.raises(RecordingError, match=r"x\.(mcap|db3|bag)"):
        open_storage(path)


def bomb(size: int) -> bytes:
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    zeros = bytes(1 << 20)
    parts = [compressor.compress(zeros) for _ in range(size >> 20)]
    return b"".join([*parts, compressor.flush()])


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_decompression_is_bounded(compression: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import lz4.frame

    monkeypatch.setattr("dyfn_ros.recordings.storage.base.MAX_BYTES", 8 << 20)
    data = bomb(64 << 20) if compression == "zstd" else lz4.frame.compress(bytes(64 << 20))
    with pytest.raises(OverflowError, match="come out of"):
        decompress(compression, data)
    small = zstandard.compress(b"a" * 3_000_000)
    if compression == "lz4":
        small = lz4.frame.compress(b"a" * 3_000_000)
    assert decompress(compression, small) == b"a" * 3_000_000
    with pytest.raises(EOFError, match="ends early"):
        decompress(compression, small[:-9])
    with pytest.raises(ValueError, match="compression 'rar' is unknown"):
        decompress("rar", small)


def test_chunks_that_overlap_are_merged_and_few_are_open_at_once() -> None:
    spans = [Span(i, i + 15, 1000 + i, 1) for i in range(40)]
    opened: list[int] = []

    def read(span: Span) -> list[Recorded]:
        opened.append(span.offset)
        times = range(span.start_ns, span.end_ns + 1, 5)
        return [Recorded(TOPIC, IMAGE, t, bytes([span.start_ns])) for t in times]

    found = []
    for recorded in merged(spans, read):
        found.append((recorded.log_ns, recorded.data))
        if len(found) == 1:
            assert len(opened) == 1
    assert found == sorted(found) and len(found) == 160
    many = [Span(0, 9, i, 1) for i in range(5 * MAX_OPEN)]
    opened.clear()
    next(merged(many, read))
    assert len(opened) == MAX_OPEN


def test_of_very_many_losses_the_first_are_told(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    write_mcap(path, range(100))
    data = bytearray(path.read_bytes())
    chunk = data.find(b"\x04\0\0\0zstd")
    while 0 <= chunk < len(data) // 2:
        data[chunk + 200] ^= 0xFF
        chunk = data.find(b"\x04\0\0\0zstd", chunk + 1)
    path.write_bytes(data)
    found, losses = indices(path)
    assert 40 < len(found) < 60
    assert len(losses) == MOST_LOSSES + 1 and losses[-1].startswith("and ")


LONG = 300


@pytest.mark.parametrize("kind", ["sqlite3", "zstd.mcap", "unindexed.mcap", "bz2.bag"])
def test_memory_does_not_grow_with_the_recording(tmp_path: Path, kind: str) -> None:
    """The replay's own reading: frames, not only messages."""
    most = {}
    for count in (LONG // 10, LONG):
        (tmp_path / str(count)).mkdir()
        recording = open_recording(make(tmp_path / str(count), kind, count))
        tracemalloc.start()
        assert sum(1 for _ in recording.frames()) == count
        most[count] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    images = LONG * len(image_bytes(0))
    assert most[LONG] - most[LONG // 10] < images / 10
