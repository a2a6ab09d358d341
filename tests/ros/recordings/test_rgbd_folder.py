"""One RGB-D folder through every command that reads such folders: the same frames, in one order."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dyfn_core.data.datasets import open_kind
from dyfn_core.data.sequences import folder_frames
from dyfn_core.evaluation.benchmarks.registry import open_benchmark
from dyfn_core.training.tasks.validation import recording_examples
from dyfn_ros.record.cli import ALL, PARTIAL, UNUSABLE, main
from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.open import open_recording
from tests.support.rgbd_folders import (
    MATRIX,
    SIZE,
    depth_frame_of,
    frame_of,
    metres,
    write,
    write_folder,
)

COUNT = 12
Frames = list[tuple[np.ndarray, np.ndarray]]


def replayed(folder: Path) -> Frames:
    """What dyfn-replay runs on."""
    frames = list(open_recording(folder).frames())
    assert all(frame.depth is not None for frame in frames)
    return [(frame.image, frame.depth) for frame in frames if frame.depth is not None]


def recorded(folder: Path) -> Frames:
    """What dyfn-record writes."""
    out = folder.with_name(f"{folder.name}_recorded")
    assert main([str(folder), "--out", str(out), "--colour", "png"]) in (ALL, PARTIAL)
    return replayed(out)


def trained_on(folder: Path) -> Frames:
    """What `dyfn-train --data FOLDER` trains on."""
    (sequence,), _ = open_kind("rgbd_folder", folder, {})
    read = (sequence.read(index) for index in range(len(sequence)))
    return [(frame.image, frame.depth) for frame in read]


def validated_on(folder: Path) -> Frames:
    """What a training validates on."""
    return [(example.image, example.depth) for example in recording_examples(folder, every=1)]


def scored_on(folder: Path) -> Frames:
    """What `dyfn-train evaluate --recording FOLDER` and the experiments score on."""
    return list(folder_frames(folder))


def benchmarked(folder: Path) -> Frames:
    """What `dyfn-eval run --benchmark rgbd --root FOLDER` scores on."""
    (sequence,) = open_benchmark("rgbd", folder).sequences
    return [(frame.image, frame.truth) for frame in sequence.frames()]


READERS: list[Callable[[Path], Frames]] = [
    replayed,
    recorded,
    trained_on,
    validated_on,
    scored_on,
    benchmarked,
]


def not_padded(folder: Path) -> None:
    write_folder(folder, [f"{i}.jpg" for i in range(COUNT)], [f"{i}.png" for i in range(COUNT)])


def prefixed(folder: Path) -> None:
    colours = [f"frame-{i:06}.color.PNG" for i in range(COUNT)]
    write_folder(folder, colours, [f"depth{i}.png" for i in range(COUNT)])
    (folder / "rgb" / "._frame-000000.color.PNG").write_bytes(b"\0\5\x16\7")


def times(folder: Path) -> None:
    names = [f"{1305031102.9 + i / 30:.6f}.png" for i in range(COUNT)]
    write_folder(folder, names, names)


def associations(folder: Path) -> None:
    names = [f"{i}.png" for i in range(COUNT)]
    write_folder(folder, names, names, unit=5000)
    lines = [f"{i} depth/{i}.png {i} rgb/{i}.png" for i in range(COUNT)]
    (folder / "associations.txt").write_text("\n".join(lines))


def tum(folder: Path) -> None:
    """Depth has other names than the images, and comes 15 ms before them."""
    stamps = [1305031102.9 + i / 30 for i in range(COUNT)]
    write_folder(
        folder,
        [f"{stamp:.6f}.png" for stamp in stamps],
        [f"{stamp - 0.015:.6f}.png" for stamp in stamps],
        unit=5000,
    )
    for kind, shift in (("rgb", 0.0), ("depth", 0.015)):
        lines = [f"{t - shift:.6f} {kind}/{t - shift:.6f}.png" for t in stamps]
        (folder / f"{kind}.txt").write_text("\n".join(lines))


@pytest.mark.parametrize("make", [not_padded, prefixed, times, associations, tum])
def test_every_command_reads_the_same_frames(make: Callable[[Path], None], tmp_path: Path) -> None:
    folder = tmp_path / "walk"
    make(folder)
    for read in READERS:
        frames = read(folder)
        assert [frame_of(image) for image, _ in frames] == list(range(COUNT)), read.__name__
        assert [depth_frame_of(depth) for _, depth in frames] == list(range(COUNT)), read.__name__
        for number, (_, depth) in enumerate(frames):
            np.testing.assert_allclose(depth, metres(number), atol=6e-4, err_msg=read.__name__)


def test_stamps_are_the_lists_own_else_a_tenth_of_a_second_each(tmp_path: Path) -> None:
    tum(tmp_path / "tum")
    stamps = [frame.stamp_ns for frame in open_recording(tmp_path / "tum").frames()]
    assert stamps[0] == 1305031102_900000000
    np.testing.assert_allclose(np.diff(stamps), 1e9 / 30, atol=2000)
    times(tmp_path / "times")
    stamps = [frame.stamp_ns for frame in open_recording(tmp_path / "times").frames()]
    assert stamps == [100_000_000 * i for i in range(COUNT)]


def test_what_is_not_paired_is_a_warning_of_a_replay_and_said_by_record(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    not_padded(tmp_path)
    for name in ("3.png", "10.png"):
        (tmp_path / "depth" / name).rename(tmp_path / "depth" / f"{name}.tiff")
    recording = open_recording(tmp_path)
    assert len(list(recording.frames())) == COUNT
    warnings = " ".join(recording.notes.warnings)
    assert "2 x image without depth" in warnings and "2 x .tiff file in depth/" in warnings
    assert not recording.notes.losses
    assert main([str(tmp_path), "--out", str(tmp_path / "out")]) == PARTIAL
    told = capsys.readouterr().err
    assert "2 x image without depth" in told and "2 x .tiff file in depth/" in told
    frames = list(open_recording(tmp_path / "out").frames())
    assert [frame.depth is None for frame in frames] == [i in (3, 10) for i in range(COUNT)]


@pytest.mark.parametrize("lists", [("rgb.txt", "depth.txt"), ("associations.txt",)])
@pytest.mark.parametrize("gone", [("rgb/2.png",), ("depth/3.png", "depth/4.png")])
def test_a_picture_that_a_list_names_and_that_is_gone_is_a_loss(
    lists: tuple[str, ...], gone: tuple[str, ...], tmp_path: Path
) -> None:
    folder = tmp_path / "room"
    for i in range(8):
        write(folder / "rgb" / f"{i}.png", np.full((*SIZE, 3), 20 * i, np.uint8))
        write(folder / "depth" / f"{i}.png", np.full(SIZE, 5000 + i, np.uint16))
    for name in lists:
        kinds = (name[:-4],) if len(lists) > 1 else ("rgb", "depth")
        rows = (" ".join(f"{i}.0 {kind}/{i}.png" for kind in kinds) for i in range(8))
        (folder / name).write_text("\n".join(rows))
    for name in gone:
        (folder / name).unlink()
    recording = open_recording(folder)
    list(recording.frames())
    ((loss, count),) = recording.notes.losses.items()
    assert count == len(gone) and loss.startswith(f"{folder / gone[0]}: file named in ")
    assert not any("not there" in warning for warning in recording.notes.warnings)


@pytest.mark.parametrize("name", ["rgb/2.jpg", "depth/2.png"])
def test_a_damaged_picture_is_lost_and_named(name: str, tmp_path: Path) -> None:
    not_padded(tmp_path)
    (tmp_path / name).write_bytes(b"no picture")
    recording = open_recording(tmp_path)
    frames = list(recording.frames())
    assert len(frames) == COUNT - name.startswith("rgb")
    assert [path.rpartition("/")[2] for path in recording.notes.losses] == [
        f"{name.rpartition('/')[2]}: no such image, or a damaged one"
    ]
    stamps = [frame.stamp_ns // 100_000_000 for frame in frames]
    assert stamps == [i for i in range(COUNT) if i != 2 or name.startswith("depth")]


@pytest.mark.parametrize(
    "text", ["0 0 0 0", "60 0 0\n0 60 0\n31.5 23.5 1", "1800 1800 959.5 539.5", "a b c d"]
)
def test_unusable_intrinsics_are_refused_by_name(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    not_padded(tmp_path)
    (tmp_path / "K.txt").write_text(text)
    with pytest.raises(RecordingError, match=r"K\.txt: "):
        open_recording(tmp_path)
    assert main([str(tmp_path), "--out", str(tmp_path / "out")]) == UNUSABLE
    assert "K.txt: " in capsys.readouterr().err
    assert len(scored_on(tmp_path)) == COUNT  # scores need no intrinsics


def test_depth_of_another_size_keeps_it_in_a_replay_and_intrinsics_follow_the_image(
    tmp_path: Path,
) -> None:
    write_folder(tmp_path, ["0.png"], ["0.png"])
    write(tmp_path / "rgb" / "0.png", np.full((96, 128, 3), 10, np.uint8))
    np.savetxt(tmp_path / "K.txt", MATRIX * [[2], [2], [1]])
    (frame,) = open_recording(tmp_path).frames()
    assert frame.depth is not None and frame.depth.shape == SIZE
    np.testing.assert_allclose(frame.camera_matrix, MATRIX * [[2], [2], [1]])  # type: ignore[arg-type]
    ((image, depth),) = folder_frames(tmp_path)
    assert image.shape[:2] == depth.shape == SIZE
