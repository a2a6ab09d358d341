"""Poses of another clock than the images', or of something else, are said and can be mended."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyfn_core.geometry.rigid import inverse
from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL, PARTIAL
from tests.support.odometry import odometry
from tests.support.rocking_camera import COUNT, RATE, SECOND, pictures, place
from tests.support.textured_plane import CAMERA, SIZE
from tests.support.tiny_model import load_tiny

pytestmark = pytest.mark.slow

EVERY = 3  # poses a frame
ODOMETRY = ("--metric-source", "odometry", "--write", "none")
MCAP = ("--write", "mcap")


def walk(
    path: Path, late: float, changed: Callable[[np.ndarray], np.ndarray] = lambda pose: pose
) -> Path:
    """late: seconds that the stamps of /odom are after those of the images."""
    with RecordingWriter(path) as writer:
        for stamp, image in pictures():
            writer.write_image("/camera/image", image, stamp, "camera")
            writer.write_camera_info("/camera/camera_info", CAMERA, SIZE, stamp, "camera")
        for number in range(EVERY * COUNT):
            seconds = 1 + number / RATE / EVERY
            message = odometry(changed(place(seconds)), seconds + late, child="camera")
            writer.write("/odom", "nav_msgs/msg/Odometry", message, round(seconds * SECOND))
    return path


def run(recording: Path, *options: str) -> tuple[int, list[str]]:
    out = recording.with_name("out")
    fixed = ["--out", str(out), "--model", "tiny", "--threads", "1", "--strict"]
    code = main([str(recording), *fixed, *options], load_tiny)
    metrics: dict[str, Any] = json.loads((out / "metrics.json").read_text())
    return code, metrics["warnings"]


@pytest.mark.parametrize(
    ("used", "option"), [(ODOMETRY, "--odometry-offset"), (MCAP, "--pose-offset")]
)
def test_an_offset_is_named_with_the_option_that_takes_it_away(
    tmp_path: Path, used: tuple[str, ...], option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = walk(tmp_path / "walk.mcap", 0.1)
    code, (text,) = run(recording, *used)
    assert code == PARTIAL
    assert "its stamps are 0.1 s after those of the images" in text
    assert text.endswith(f"{option} 0.1 takes that away") and text in capsys.readouterr().err
    assert run(recording, *used, option, "0.1") == (ALL, [])
    code, (text,) = run(recording, *used, option, "0.3")
    assert f"its stamps, less {option} 0.3, are 0.2 s before" in text
    assert text.endswith(f"{option} 0.1 takes that away")


def test_poses_from_world_to_camera_are_said(tmp_path: Path) -> None:
    _, (text,) = run(walk(tmp_path / "walk.mcap", 0.0, inverse), *ODOMETRY)
    assert text.startswith("/odom: its poses do not agree with the motion in the pictures")
    assert "world to camera" in text


def test_right_poses_are_believed(tmp_path: Path) -> None:
    assert run(walk(tmp_path / "walk.mcap", 0.0), *ODOMETRY) == (ALL, [])
