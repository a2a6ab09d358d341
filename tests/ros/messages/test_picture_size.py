"""Pictures that claim absurd sizes are refused by their header, before OpenCV takes memory."""

import struct
from pathlib import Path
from types import SimpleNamespace
from typing import NoReturn

import cv2
import numpy as np
import pytest

from dyfn_ros.messages.compressed_depth import decode_compressed_depth
from dyfn_ros.messages.compressed_image import decode_compressed
from dyfn_ros.messages.encodings import MessageError
from dyfn_ros.messages.images import decode_image
from dyfn_ros.messages.picture_size import MAX_PIXELS, PNG, check_picture_size
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.typestore import COMPRESSED_IMAGE, compressed_message
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.made_pictures import png


def jpeg(width: int, height: int, frame: int = 0xC0, before: bytes = b"") -> bytes:
    """A real JPEG whose start of frame says another size. before: goes in ahead of everything."""
    small = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    at = small.index(b"\xff\xc0")
    changed = small[at : at + 5].replace(b"\xff\xc0", bytes([0xFF, frame]))
    size = struct.pack(">HH", height, width)
    return small[:2] + before + small[2:at] + changed + size + small[at + 9 :]


THUMBNAIL = b"\xff\xe1" + struct.pack(">H", 2 + 8) + b"\xff\xc0\0\x11\x08\0\x01\0"  # in APP1
HUGE = {
    "png": png(60_000, 60_000),
    "jpeg": jpeg(60_000, 60_000),
    "progressive": jpeg(60_000, 60_000, frame=0xC2),
    "after-metadata": jpeg(60_000, 60_000, before=THUMBNAIL),
    "after-garbage": jpeg(60_000, 60_000, before=b"\xff\xe0\0\2abc\xff\xff\0\xd0"),
}


@pytest.fixture
def no_decoder(monkeypatch: pytest.MonkeyPatch) -> None:
    def decode(*_: object) -> NoReturn:
        raise AssertionError("decoded")

    monkeypatch.setattr(cv2, "imdecode", decode)


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("kind", HUGE)
def test_an_absurd_size_is_refused_before_decoding(kind: str) -> None:
    message = SimpleNamespace(data=HUGE[kind], format="bgr8; compressed bgr8")
    with pytest.raises(MessageError, match=r"60000 x 60000 pixels; at most .*64 megapixels"):
        decode_compressed(message)


@pytest.mark.usefixtures("no_decoder")
@pytest.mark.parametrize("layout", ["16UC1; png compressed", "16UC1; compressedDepth png"])
def test_an_absurd_depth_is_refused_before_decoding(layout: str) -> None:
    data = png(60_000, 60_000, bits=16, colour=0)
    head = bytes(12) if "compressedDepth" in layout else b""
    with pytest.raises(MessageError, match=r"60000 x 60000 pixels"):
        decode_compressed_depth(SimpleNamespace(data=head + data, format=layout))


def test_the_size_read_is_the_size_decoded() -> None:
    """The limit is on the product, and what a JPEG's thumbnail says does not count."""
    side = round(MAX_PIXELS**0.5)
    for make in (png, jpeg):
        check_picture_size(make(side, side))
        with pytest.raises(MessageError, match=f"{side} x {side + 1} pixels"):
            check_picture_size(make(side, side + 1))
    picture = np.random.default_rng(0).integers(0, 255, (30, 50, 3), np.uint8)
    for suffix, options in ((".png", []), (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])):
        data = cv2.imencode(suffix, picture, options)[1].tobytes()
        assert decode_compressed(SimpleNamespace(data=data, format="")).shape == picture.shape


@pytest.mark.parametrize("data", [PNG + bytes(30), b"\xff\xd8\xff\xd9", b"\xff\xd8\xff\xc0\0\x11"])
def test_a_header_without_a_size_is_refused(data: bytes) -> None:
    with pytest.raises(MessageError, match="cannot be decoded: no header says its size"):
        check_picture_size(data)


def test_a_replay_goes_on_and_names_topic_and_size(tmp_path: Path) -> None:
    image, depth = np.full((24, 32, 3), 90, np.uint8), np.full((24, 32), 2.0)
    with RecordingWriter(tmp_path / "bag") as writer:
        for index in range(3):
            writer.write_jpeg("/cam/image/compressed", image, index * 10, "camera")
            writer.write_depth("/cam/depth/compressed", depth, index * 10, "camera", "png")
        for topic, data, layout, stamp in (
            ("/cam/image/compressed", HUGE["png"], "png", 15),
            ("/cam/image/compressed", image_bytes(image), "jpeg", 30),
            ("/cam/depth/compressed", png(50_000, 2_000, 16, 0), "16UC1; png", 30),
        ):
            message = compressed_message(np.frombuffer(data, np.uint8), layout, stamp, "camera")
            writer.write(topic, COMPRESSED_IMAGE, message, stamp)
    recording = open_recording(tmp_path / "bag", tolerance=1e-9)
    assert [frame.depth is None for frame in recording.frames()] == [False, False, False, True]
    losses = sorted(recording.notes.losses)
    assert len(losses) == 2
    assert losses[0].startswith("/cam/depth/compressed: depth skipped: the picture says that it")
    assert "50000 x 2000" in losses[0]
    assert losses[1].startswith("/cam/image/compressed: image skipped: the picture says that it")
    assert "60000 x 60000" in losses[1]


def image_bytes(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def test_the_limit_is_the_callers_for_raw_images_and_files() -> None:
    image = np.full((24, 32, 3), 90, np.uint8)
    raw = SimpleNamespace(
        data=image.tobytes(), height=24, width=32, encoding="rgb8", step=96, is_bigendian=0
    )
    packed = SimpleNamespace(data=image_bytes(image), format="jpeg")
    for decode, message in ((decode_image, raw), (decode_compressed, packed)):
        assert decode(message, 24 * 32).shape == (24, 32, 3)
        with pytest.raises(MessageError, match="32 x 24 pixels; at most 767"):
            decode(message, 24 * 32 - 1)
