"""Whatever is done to a recording's bytes, it is read in part or refused: no crash, no hang."""

import tempfile
import tracemalloc
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from dyfn_ros.recordings.open import RecordingError, open_recording
from dyfn_ros.recordings.rgbd_writer import FrameToRecord, write_rgbd_recording
from tests.support.made_recordings import MAKERS, make, shade

COUNT = 5
CAMERA = np.array([[40.0, 0, 15.5], [0, 40.0, 11.5], [0, 0, 1]])
RGBD = ["rgbd.db3", "rgbd.mcap"]  # JPEG, PNG and CameraInfo
KINDS = [*MAKERS, *RGBD]
MOST_BYTES = 64 << 20  # of Python's own at once, for recordings of some ten kilobytes
SECONDS = 5

Damage = tuple[str, float, float, bytes]
damages = st.lists(
    st.tuples(
        st.sampled_from(["cut", "flip", "overwrite", "insert", "move", "huge"]),
        st.floats(0, 1),
        st.floats(0, 1),
        st.binary(min_size=1, max_size=40),
    ),
    min_size=1,
    max_size=3,
)


def damaged(data: bytes, damage: Damage) -> bytes:
    kind, where, other, garbage = damage
    here, there = int(where * len(data)), int(other * len(data))
    changed = bytearray(data)
    if kind == "cut":
        return data[:here]
    if kind == "flip" and here < len(data):
        changed[here] ^= 1 << (there % 8)
    elif kind == "overwrite":
        changed[here : here + len(garbage)] = garbage
    elif kind == "insert":
        changed[here:here] = garbage
    elif kind == "move":
        changed[here:here] = data[there : there + 3000]
    elif kind == "huge":  # a length, most likely
        changed[here : here + 4] = b"\xff\xff\xff\x7f"
    return bytes(changed)


@cache
def intact(kind: str) -> dict[str, bytes]:
    """File name within the recording ("" for the only one) -> bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / kind
        if kind in RGBD:
            depth = np.full((24, 32), 2.0)
            frames = [FrameToRecord(shade(i), depth, CAMERA, None, i / 10) for i in range(COUNT)]
            write_rgbd_recording(path, frames)
        else:
            make(Path(folder), kind, COUNT)
        files = [path] if path.is_file() else sorted(path.iterdir())
        return {"" if file == path else file.name: file.read_bytes() for file in files}


def read(kind: str, files: dict[str, bytes]) -> int:
    """How many frames there are; a recording that is refused has none."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / kind
        if "" not in files:
            path.mkdir()
        for name, data in files.items():
            (path / name if name else path).write_bytes(data)
        try:
            return sum(1 for _ in open_recording(path).frames())
        except RecordingError as error:
            assert kind in str(error)
            return 0


@pytest.mark.parametrize("kind", KINDS)
def test_the_recordings_are_whole_before(kind: str) -> None:
    assert read(kind, intact(kind)) == COUNT


@settings(
    max_examples=300,
    deadline=SECONDS * 1000,
    derandomize=True,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
@given(st.sampled_from(KINDS), damages, st.integers(0, 5))
def test_damage_of_any_kind_is_survived(kind: str, several: list[Damage], which: int) -> None:
    files = dict(intact(kind))
    name = sorted(files)[which % len(files)]
    for damage in several:
        files[name] = damaged(files[name], damage)
    tracemalloc.start()
    try:
        count = read(kind, files)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert count <= 3 * COUNT  # "move" may repeat some
    assert most < MOST_BYTES
