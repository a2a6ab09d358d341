"""The report of a replay as a browser shows it."""

from pathlib import Path

import pytest

from dyfn_ros.recordings.writer import RecordingWriter
from dyfn_ros.replay.cli import main
from tests.support.browser import FITS, assert_fits, look
from tests.support.rectangles import rectangles
from tests.support.tiny_model import load_tiny

SECOND = 1_000_000_000
pytestmark = pytest.mark.slow


def write(path: Path) -> Path:
    with RecordingWriter(path) as writer:
        for index in range(8):
            image, depth = rectangles(index)
            stamp = SECOND + index * SECOND // 10
            writer.write_image("/camera/image", image, stamp, "camera")
            writer.write_depth("/camera/depth", depth, stamp, "camera")
    return path


def test_the_report_fits_1280_and_500_pixels(tmp_path: Path) -> None:
    recording = write(tmp_path / "a recording with quite a long name, as they have")
    out = tmp_path / "out"
    options = ["--out", str(out), "--write", "none", "--model", "tiny", "--compare", "--controls"]
    assert main([str(recording), *options], load_tiny) == 0
    assert_fits(look(out / "report.html", (1280, 500), f"{FITS} return fit;", tmp_path))
