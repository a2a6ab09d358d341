"""16-bit PNG depth and the compressedDepth transport, by value."""

import struct

import cv2
import numpy as np
import pytest

from dyfn_ros.messages.compressed_depth import (
    decode_compressed_depth,
    encode_compressed_depth,
    is_compressed_depth,
)
from dyfn_ros.messages.encodings import MessageError
from dyfn_ros.recordings.typestore import compressed_message


def png(values: np.ndarray) -> bytes:
    return cv2.imencode(".png", values)[1].tobytes()


def message(layout: str, data: bytes) -> object:
    return compressed_message(np.frombuffer(data, np.uint8), layout, 0, "camera")


MILLIMETRES = np.array([[0, 1, 1500], [65535, 2000, 3]], np.uint16)


@pytest.mark.parametrize("layout", ["16UC1; png compressed", "png", ""])
def test_png_is_millimetres_and_both_ends_are_none(layout: str) -> None:
    depth = message(layout, png(MILLIMETRES))
    assert is_compressed_depth(depth)
    expected = np.array([[np.nan, 0.001, 1.5], [np.nan, 2, 0.003]], np.float32)
    np.testing.assert_allclose(decode_compressed_depth(depth), expected, rtol=1e-6)
    assert decode_compressed_depth(depth, full=True)[1, 0] == np.float32(65.535)


def test_compressed_depth_of_16uc1_skips_its_header() -> None:
    data = struct.pack("<iff", 0, 0, 0) + png(MILLIMETRES)
    depth = message("16UC1; compressedDepth png", data)
    assert is_compressed_depth(depth)
    assert decode_compressed_depth(depth)[0, 2] == pytest.approx(1.5)


def test_compressed_depth_of_32fc1_is_inverse_depth() -> None:
    a, b = 100.0 * 101, 100.0
    metres = np.array([[1.0, 2.0, 8.0]])
    values = np.append(np.round(a / metres + b), 0).astype(np.uint16)[None]
    depth = message("32FC1; compressedDepth png", struct.pack("<iff", 0, a, b) + png(values))
    decoded = decode_compressed_depth(depth)
    np.testing.assert_allclose(decoded[:, :3], metres, rtol=1e-3)
    assert np.isnan(decoded[0, 3])


@pytest.mark.parametrize(("encoding", "error"), [("32FC1", 1e-3), ("16UC1", 2e-3)])
def test_what_is_packed_is_unpacked(encoding: str, error: float) -> None:
    depth = np.geomspace(0.5, 9.9, 60, dtype=np.float32).reshape(6, 10)
    valid = np.arange(60).reshape(6, 10) % 7 != 0
    layout, data = encode_compressed_depth(depth, valid, encoding)
    assert layout == f"{encoding}; compressedDepth png"
    decoded = decode_compressed_depth(message(layout, data))
    assert np.array_equal(np.isnan(decoded), ~valid)
    np.testing.assert_allclose(decoded[valid], depth[valid], rtol=error)


def test_what_does_not_fit_is_packed_as_none() -> None:
    depth = np.array([[0.05, 0.2, 5.0, 19.0, 21.0, 70.0]], np.float32)
    valid = np.ones((1, 6), bool)
    layout, data = encode_compressed_depth(depth, valid, farthest=20.0)
    found = np.isfinite(decode_compressed_depth(message(layout, data)))
    assert found.tolist() == [[False, True, True, True, False, False]]
    layout, data = encode_compressed_depth(depth, valid, "16UC1")
    found = np.isfinite(decode_compressed_depth(message(layout, data)))
    assert found.tolist() == [[True, True, True, True, True, False]]


def test_colour_is_not_depth() -> None:
    colour = message("jpeg", png(np.zeros((2, 2, 3), np.uint8)))
    assert not is_compressed_depth(colour)
    with pytest.raises(MessageError, match="expected a 16-bit grey PNG, found uint8"):
        decode_compressed_depth(colour)


@pytest.mark.parametrize(
    ("layout", "data", "reason"),
    [
        ("16UC1; compressedDepth png", b"\0" * 5, "ends early: 5 bytes"),
        ("16UC1; compressedDepth png", b"\0" * 40, "expected a 16-bit PNG, found none"),
        ("16UC1; compressedDepth rvl", b"\0" * 15, "the RVL image ends early: 3 bytes"),
        ("16UC1; png compressed", png(MILLIMETRES)[:-20], "ends early"),
    ],
)
def test_broken_depth_is_named_by_its_format(layout: str, data: bytes, reason: str) -> None:
    with pytest.raises(MessageError, match=reason) as error:
        decode_compressed_depth(message(layout, data))
    assert layout in str(error.value)
