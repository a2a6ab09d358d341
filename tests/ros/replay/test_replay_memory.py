"""What a replay keeps of a frame, with every output on: its row in the tables, and no picture."""

import gc
import importlib.util
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from dyfn_core.evaluation import sequence
from dyfn_core.evaluation.report import worst_frames
from dyfn_core.geometry import voxel_grid
from dyfn_core.scoring import protocols
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from dyfn_ros.replay.cli import main
from dyfn_ros.replay.jobs import ALL
from tests.support.tiny_model import load_tiny
from tests.support.wall_walk import CAMERA, SIZE, WALL, camera_pose

SHORT, LONG = 30, 150  # frames
ROUND = 10  # frames until the camera is where it was
KEPT = 3500  # bytes a frame, with some noise; the smallest array of a frame has 5184
OUTPUTS = ["mcap", "ply", *(o for o, m in (("video", "av"), ("rrd", "rerun"))
                            if importlib.util.find_spec(m))]  # fmt: skip


class FewSamples(protocols.SequenceScorer):
    """Its limit is reached after some frames; of the usual one, after some hundred."""

    def __init__(self, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)  # type: ignore[arg-type]
        self.max_samples = 10_000


def peak(folder: Path, count: int) -> int:
    """The most bytes that Python and numpy held at once while so many frames were replayed."""
    rng = np.random.default_rng(1)
    picture = cv2.resize(rng.integers(0, 255, (6, 8, 3), np.uint8), SIZE[::-1])
    frames = []
    for index in range(count):
        place = index % ROUND
        depth = np.full(SIZE, WALL - 0.3 * place)
        image = np.roll(picture, place, axis=1)
        frames.append(FrameToRecord(image, depth, CAMERA, camera_pose(place), 50 + index / 10))
    write_rgbd_recording(folder / f"walk{count}", frames)
    arguments = [str(folder / f"walk{count}"), "--out", str(folder / f"out{count}")]
    gc.collect()
    tracemalloc.start()
    try:
        options = ["--model", "tiny", "--threads", "1", "--write", ",".join(OUTPUTS)]
        assert main([*arguments, *options], load_tiny) == ALL
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_peak_memory_does_not_depend_on_the_number_of_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequence, "SequenceScorer", FewSamples)
    monkeypatch.setattr(voxel_grid, "_PENDING", 10_000)
    monkeypatch.setattr(worst_frames, "WIDTH", 16)  # at most 30 pictures, but not always as many
    peak(tmp_path, 2)  # what is loaded once
    short, long = peak(tmp_path, SHORT), peak(tmp_path, LONG)
    assert (tmp_path / f"out{LONG}" / "cloud.ply").exists()
    assert (long - short) / (LONG - SHORT) < KEPT
