"""Compressed video in recordings: every picture at the time of its message, or a named loss."""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from dyfn_ros.recordings.errors import RecordingError
from dyfn_ros.recordings.frames import RecordedFrame
from dyfn_ros.recordings.open import image_topics, open_recording
from dyfn_ros.recordings.typestore import (
    COMPRESSED_IMAGE,
    COMPRESSED_VIDEO,
    FFMPEG_PACKET,
    IMAGE,
    TYPES,
    compressed_message,
    header,
    image_message,
    video_message,
)
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.numbered import SECOND, depth, numbers

av = pytest.importorskip("av")
COUNT, SIZE = 10, (24, 32)
ENCODERS = {
    "h264": ("libx264", {"tune": "zerolatency", "x264-params": "keyint=5:scenecut=0"}),
    "h264 that comes late": ("libx264", {"bf": "0", "x264-params": "keyint=5:scenecut=0"}),
    "h265": ("libx265", {"x265-params": "bframes=0:log-level=none:keyint=5"}),
    "vp9": ("libvpx-vp9", {"lag-in-frames": "0", "auto-alt-ref": "0"}),
}


def stamp(index: int) -> int:
    return SECOND + index * SECOND // 10


def shade(index: int) -> np.ndarray:
    return np.full((*SIZE, 3), 60 + 15 * index, np.uint8)


def packets(name: str) -> list[bytes]:
    """One for each picture; the fifth picture after a key frame is one."""
    encoder_name, options = ENCODERS[name]
    try:
        encoder = av.CodecContext.create(encoder_name, "w")
    except av.codec.codec.UnknownCodecError:
        pytest.skip(f"no encoder {encoder_name} here")
    encoder.height, encoder.width = SIZE
    encoder.pix_fmt, encoder.time_base = "yuv420p", Fraction(1, 10)
    encoder.gop_size, encoder.options = 5, options
    found = []
    for index in range(COUNT):
        frame = av.VideoFrame.from_ndarray(shade(index), format="rgb24")
        frame.pts = index
        found += encoder.encode(frame)
    found += encoder.encode(None)
    assert [packet.pts for packet in found] == list(range(COUNT))
    return [bytes(packet) for packet in found]


def video(index: int, data: bytes, name: str = "h264") -> tuple[str, Any]:
    message = video_message(np.frombuffer(data, np.uint8), name, stamp(index), "camera")
    return COMPRESSED_VIDEO, message


def packet(index: int, data: bytes) -> tuple[str, Any]:
    fields = {"width": SIZE[1], "height": SIZE[0], "encoding": "libx264", "pts": index, "flags": 0}
    message = TYPES.types[FFMPEG_PACKET](
        header=header(stamp(index), "camera"),
        **fields,
        is_bigendian=False,
        data=np.frombuffer(data, np.uint8),
    )
    return FFMPEG_PACKET, message


def compressed(index: int, data: bytes) -> tuple[str, Any]:
    message = compressed_message(np.frombuffer(data, np.uint8), "h264", stamp(index), "camera")
    return COMPRESSED_IMAGE, message


def write(
    path: Path, messages: list[tuple[str, Any]], kept: range | list[int] = range(COUNT)
) -> Path:
    """These messages of the topic /cam, and a depth at the stamp of each that is left out too."""
    with RecordingWriter(path) as writer:
        for index in range(COUNT):
            if index in kept:
                writer.write("/cam", *messages[index], stamp(index))
            truth = image_message(depth(index), "32FC1", stamp(index), "camera")
            writer.write("/depth", IMAGE, truth, stamp(index))
    return path


def check(frames: list[RecordedFrame], expected: list[int]) -> None:
    assert [frame.stamp_ns for frame in frames] == [stamp(index) for index in expected]
    assert numbers(frames) == expected
    for frame, index in zip(frames, expected, strict=True):
        assert frame.frame_id == "camera" and frame.image.shape == (*SIZE, 3)
        assert abs(float(frame.image.mean()) - shade(index).mean()) < 4


@pytest.mark.parametrize("name", ENCODERS)
def test_pictures_of_a_video_topic_have_the_depth_of_their_messages(
    tmp_path: Path, name: str
) -> None:
    messages = [video(i, data, name.split()[0]) for i, data in enumerate(packets(name))]
    recording = open_recording(write(tmp_path / "bag", messages))
    for _ in range(2):  # it can be read again
        check(list(recording.frames()), [*range(COUNT)])
        assert not recording.notes.losses and not recording.notes.warnings
    assert recording.topics.image == "/cam" and recording.expected_frames == COUNT
    assert image_topics(tmp_path / "bag") == ["/cam"]


@pytest.mark.parametrize("maker", [packet, compressed])
def test_other_messages_of_video_are_read(
    tmp_path: Path, maker: Callable[[int, bytes], tuple[str, Any]]
) -> None:
    messages = [maker(i, data) for i, data in enumerate(packets("h264"))]
    recording = open_recording(write(tmp_path / "bag", messages))
    check(list(recording.frames()), [*range(COUNT)])
    assert not recording.notes.losses and not recording.notes.warnings


def test_foxglove_video_in_json_is_read(tmp_path: Path) -> None:
    with (tmp_path / "walk.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedVideo", "jsonschema", b"{}")
        channel = writer.register_channel("/cam", "json", schema)
        for index, data in enumerate(packets("h264")):
            sec, nsec = divmod(stamp(index), SECOND)
            text = {
                "timestamp": {"sec": sec, "nsec": nsec},
                "frame_id": "camera",
                "format": "h264",
                "data": base64.b64encode(data).decode(),
            }
            writer.add_message(channel, stamp(index), json.dumps(text).encode(), stamp(index))
        writer.finish()
    frames = list(open_recording(tmp_path / "walk.mcap").frames())
    assert [round((frame.image.mean() - 60) / 15) for frame in frames] == [*range(COUNT)]
    assert [frame.stamp_ns for frame in frames] == [stamp(index) for index in range(COUNT)]


def test_what_gives_no_picture_is_counted(tmp_path: Path) -> None:
    """A recording that begins between two key frames, and a message that is no video."""
    messages = [video(i, data, "h265") for i, data in enumerate(packets("h265"))]
    messages[7] = video(7, b"no video at all", "h265")
    recording = open_recording(write(tmp_path / "bag", messages, kept=[2, 3, 4, 5, 6, 7]))
    check(list(recording.frames()), [5, 6])
    (loss,) = recording.notes.losses
    assert loss.startswith("/cam: image skipped: no picture comes of a message of hevc")
    assert recording.notes.losses[loss] == 4


@pytest.mark.parametrize(
    ("text", "installed", "said"),
    [
        ("mpeg1", True, "/cam is compressed video of format 'mpeg1', expected one of h264"),
        ("h264", False, "/cam is compressed video (h264), which needs `pip install 'dyfn_ros[vi"),
    ],
)
def test_video_that_cannot_be_decoded_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, installed: bool, said: str
) -> None:
    write(tmp_path / "bag", [video(i, b"\0\0\0\1", text) for i in range(COUNT)])
    if not installed:
        monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(RecordingError) as caught:
        next(open_recording(tmp_path / "bag").frames())
    assert said in str(caught.value)
