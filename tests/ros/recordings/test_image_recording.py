"""A video file and a folder of pictures replay as recordings without depth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from dyfn_ros.demo.odometry import read_odometry
from dyfn_ros.recordings.open import image_topics, open_recording
from dyfn_ros.recordings.poses import PoseError, open_poses
from dyfn_ros.recordings.video_file import video_frames
from dyfn_ros.replay.cli import main
from tests.support.made_videos import make_video
from tests.support.tiny_model import load_tiny


def pictures(folder: Path, numbers: tuple[int, ...]) -> Path:
    folder.mkdir()
    for number in numbers:
        picture = np.full((48, 64, 3), number, np.uint8)
        assert cv2.imwrite(str(folder / f"view {number}.png"), picture)
    return folder


def test_a_video_is_a_recording_with_its_times(tmp_path: Path) -> None:
    times = [0, 0.04, 0.2]
    recording = open_recording(make_video(tmp_path / "v.MP4", times))
    frames = list(recording.frames())
    assert [frame.stamp_ns / 1e9 for frame in frames] == pytest.approx(times, abs=1e-3)
    assert recording.expected_frames == 3 and not recording.notes.losses
    assert all(frame.depth is None and frame.camera_matrix is None for frame in frames)
    assert image_topics(tmp_path / "v.MP4") == [None]
    with pytest.raises(PoseError, match="holds pictures"):
        open_poses(tmp_path / "v.MP4", "camera")
    nothing, why = read_odometry(tmp_path / "v.MP4", "camera")
    assert nothing is None and why.endswith("holds pictures, and no odometry topic")


def test_a_folder_of_pictures_is_a_recording(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "photos", (10, 9, 30))
    (folder / "view 20.jpg").write_bytes(b"no picture")
    recording = open_recording(folder)
    frames = list(recording.frames())
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [9, 10, 30]
    assert [frame.stamp_ns for frame in frames] == [0, 100_000_000, 300_000_000]
    (loss,) = recording.notes.losses
    assert "view 20.jpg" in loss


@pytest.mark.parametrize("kind", ["video", "folder"])
def test_replay_takes_it_and_names_the_command_for_depth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    source = tmp_path / "walk.mp4" if kind == "video" else tmp_path / "walk"
    if kind == "video":
        make_video(source, [0, 0.1])
    else:
        pictures(source, (1, 2))
    words = [str(source), "--out", str(tmp_path / "out"), "--write", "none"]
    assert main(words, loader=lambda name, device: load_tiny()) == 0
    assert f"nothing is scored; for depth as video or files: dyfn-depth {source}" in (
        capsys.readouterr().out
    )
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"] == 2
    for wanted in ("reference", "odometry"):
        assert main([*words, "--metric-source", wanted]) == 2
        assert "expected a recording with" in capsys.readouterr().err


def test_times_that_vary_are_no_loss_where_the_container_counts_no_frames(tmp_path: Path) -> None:
    """Matroska has a length and a mean rate, whose product is no number of frames."""
    warnings: list[str] = []
    video = make_video(tmp_path / "v.mkv", [0, 0.02, 0.04, 0.06, 1.5])
    assert len(list(video_frames(video, warnings.append))) == 5
    assert warnings == []


def test_a_video_that_ends_early_says_so(tmp_path: Path) -> None:
    warnings: list[str] = []
    video = make_video(tmp_path / "v.mkv", [index / 10 for index in range(60)], (240, 320))
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 3])
    frames = list(video_frames(video, warnings.append))
    assert 0 < len(frames) < 40
    assert len(warnings) == 1 and "announced are 5.9 s" in warnings[0]


@pytest.mark.parametrize("name", ["12:30.mp4", "http:walk.mp4", "50%41.mp4"])
def test_a_name_is_no_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    make_video(tmp_path / "walk.mp4", [0.0, 0.04, 0.08]).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    recording = open_recording(Path(name))
    assert recording.expected_frames == 3
    assert len([*recording.frames()]) == 3
    assert not recording.notes.losses
