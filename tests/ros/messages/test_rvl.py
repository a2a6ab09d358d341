"""compressedDepth in RVL, by an encoder of our own after the published description."""

import struct
import time
from pathlib import Path

import numpy as np
import pytest

from dyfn_ros.messages.compressed_depth import decode_compressed_depth, is_compressed_depth
from dyfn_ros.messages.encodings import MessageError
from dyfn_ros.messages.rvl import decode_rvl
from dyfn_ros.recordings.open import open_recording
from dyfn_ros.recordings.typestore import (
    COMPRESSED_IMAGE,
    compressed_message,
    depth_to_millimetres,
)
from dyfn_ros.recordings.writer import RecordingWriter
from tests.support.numbered import SECOND, depth, numbers, picture
from tests.support.rvl import encode_rvl

LAYOUT = "16UC1; compressedDepth rvl"


def images() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    noise = random.integers(0, 65536, (17, 23)).astype(np.uint16)
    return {
        "noise": noise,
        "holes": np.where(random.random((17, 23)) < 0.5, 0, noise).astype(np.uint16),
        "no value": np.zeros((5, 7), np.uint16),
        "all values": np.full((5, 7), 65535, np.uint16),
        "zeros at the end": np.array([[1, 2, 0], [0, 0, 0]], np.uint16),
        "one pixel": np.array([[700]], np.uint16),
    }


@pytest.mark.parametrize("name", [*images()])
def test_every_image_comes_back(name: str) -> None:
    image = images()[name]
    np.testing.assert_array_equal(decode_rvl(encode_rvl(image)), image)


def test_a_code_written_out_by_hand() -> None:
    # 0 zeros, 1 value, +2 (zigzag 4), then 1 zero and no value: nibbles 0 1 4 1 0, and padding.
    data = struct.pack("<III", 2, 1, 0x01410000)
    assert decode_rvl(data).tolist() == [[2, 0]]


def test_inverse_depth_is_read() -> None:
    a, b = 100.0 * 101, 100.0
    metres = np.array([[1.0, 2.0, 8.0]])
    values = np.append(np.round(a / metres + b), 0).astype(np.uint16)[None]
    data = struct.pack("<iff", 0, a, b) + encode_rvl(values)
    message = compressed_message(np.frombuffer(data, np.uint8), "32FC1; compressedDepth rvl", 0, "")
    assert is_compressed_depth(message)
    decoded = decode_compressed_depth(message)
    np.testing.assert_allclose(decoded[:, :3], metres, rtol=1e-3)
    assert np.isnan(decoded[0, 3])


def test_a_recording_with_rvl_depth_is_scored_with_its_depth(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "bag") as writer:
        for index in range(4):
            stamp = SECOND + index * SECOND // 10
            data = bytes(12) + encode_rvl(depth_to_millimetres(depth(index)))
            packed = compressed_message(np.frombuffer(data, np.uint8), LAYOUT, stamp, "camera")
            writer.write("/depth/image_raw/compressedDepth", COMPRESSED_IMAGE, packed, stamp)
            writer.write_image("/image", picture(index), stamp, "camera")
    recording = open_recording(tmp_path / "bag")
    assert numbers(recording.frames()) == [0, 1, 2, 3]
    assert not recording.notes.losses


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\0" * 7, "ends early: 7 bytes"),
        (struct.pack("<II", 1 << 16, 1 << 16), "says that it is 65536 x 65536 pixels"),
        (encode_rvl(images()["noise"])[:-40], "ends early|damaged"),
        (struct.pack("<IIII", 9, 9, 0x11111111, 0x11111111), "ends early|damaged"),
        (struct.pack("<III", 2, 1, 0), "damaged at pixel 0 of 2"),
        (struct.pack("<III", 2, 1, 0x01F00000), "ends early|damaged"),
        (struct.pack("<III", 2, 1, 0x01310000), "values beyond 16 bits"),
        (struct.pack("<IIII", 2, 1, 0xFFFFFFFF, 0xFFFFFFF0), "a number of more than 32 bits"),
    ],
)
def test_damage_is_named(data: bytes, said: str) -> None:
    layout_and_all = bytes(12) + data
    message = compressed_message(np.frombuffer(layout_and_all, np.uint8), LAYOUT, 0, "")
    with pytest.raises(MessageError, match=said) as error:
        decode_compressed_depth(message)
    assert LAYOUT in str(error.value)


def test_cut_and_changed_codes_never_raise_anything_else() -> None:
    random = np.random.default_rng(1)
    code = encode_rvl(images()["holes"])
    for _ in range(300):
        changed = np.frombuffer(code, np.uint8)[: random.integers(8, len(code) + 1)].copy()
        changed[random.integers(8, len(changed) + 1) - 1 :][:1] = random.integers(0, 256)
        try:
            assert decode_rvl(changed.tobytes()).dtype == np.uint16
        except MessageError:
            continue


def test_an_image_of_a_sensor_is_fast() -> None:
    image = np.tile(depth_to_millimetres(depth(1)), (20, 20))
    image[::7, ::3] = 0
    data = encode_rvl(image)
    start = time.process_time()
    np.testing.assert_array_equal(decode_rvl(data), image)
    assert time.process_time() - start < 2
